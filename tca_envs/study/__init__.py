"""Studies on the arm that write figures and tables: python -m tca_envs.study --help lists them."""
