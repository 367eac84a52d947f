"""A web page to play with the arm: python -m tca_envs.viewer (needs the extra `viewer`)."""
