"""Training settings per task and algorithm: SAC's are tuned for two CPU cores, PPO's are a start."""

from typing import Any

ALGORITHMS = ("sac", "ppo")
"""Names of the Stable-Baselines3 learners that `train.py` offers."""

DEFAULT_ALGORITHM = {"reach": "sac", "twist-align": "sac"}

HYPERPARAMETERS: dict[str, dict[str, dict[str, Any]]] = {
    "reach": {
        "sac": {
            "env": "TCAReachDense-v0",
            "steps": 60_000,
            "envs": 4,
            "policy_kwargs": {"net_arch": [64, 64]},
            "learning_rate": 1e-3,
            "batch_size": 256,
            "gamma": 0.95,
            "learning_starts": 1_000,
            "train_freq": 1,
            "gradient_steps": 1,
            "buffer_size": 100_000,
        },
        "ppo": {
            "env": "TCAReachDense-v0",
            "steps": 500_000,
            "envs": 8,
            "policy_kwargs": {"net_arch": [64, 64], "log_std_init": -0.5},
            "learning_rate": 1e-3,
            "n_steps": 256,
            "batch_size": 512,
            "n_epochs": 8,
            "gamma": 0.95,
            "gae_lambda": 0.9,
        },
    },
    "twist-align": {
        "sac": {
            "env": "TCATwistAlignDense-v0",
            "steps": 150_000,
            "envs": 4,
            "policy_kwargs": {"net_arch": [128, 128]},
            "learning_rate": 1e-3,
            "batch_size": 256,
            "gamma": 0.95,
            "learning_starts": 1_000,
            "train_freq": 1,
            "gradient_steps": 1,
            "buffer_size": 200_000,
        },
        "ppo": {
            "env": "TCATwistAlignDense-v0",
            "steps": 1_000_000,
            "envs": 8,
            "policy_kwargs": {"net_arch": [64, 64], "log_std_init": -0.5},
            "learning_rate": 1e-3,
            "n_steps": 256,
            "batch_size": 512,
            "n_epochs": 8,
            "gamma": 0.95,
            "gae_lambda": 0.9,
        },
    },
}
"""`env`, `steps` and `envs` are the environment, the default number of its steps and how many are stepped together;
the rest goes to the learner."""
