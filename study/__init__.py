"""Studies on the arm that write figures and tables: python -m study --help lists them."""
