"""Controllers, evaluation and training of policies for the environments of `tca_envs`."""
