"""Training settings per task and algorithm: each task's default algorithm is tuned for two CPU cores, others are a start."""

from typing import Any


def decaying(remaining: float) -> float:
    """Return the learning rate when the part `remaining` of the training is left: 1e-3, at the end 1e-4."""
    return 1e-3 * 10.0 ** (remaining - 1.0)


ALGORITHMS = ("sac", "ppo", "dagger")
"""Learners that `train.py` offers: Stable-Baselines3's, and imitation of the scripted controller (`agents.dagger`)."""

DEFAULT_ALGORITHM = {"reach": "sac", "twist-align": "sac", "pick-and-place": "dagger"}

SAC: dict[str, Any] = {
    "envs": 4,
    "learning_rate": 1e-3,
    "batch_size": 256,
    "gamma": 0.95,
    "learning_starts": 1_000,
    "train_freq": 1,
    "gradient_steps": 1,
}
"""What SAC has in common on all tasks."""

HYPERPARAMETERS: dict[str, dict[str, dict[str, Any]]] = {
    "reach": {
        "sac": {
            **SAC,
            "env": "TCAReachDense-v0",
            "steps": 60_000,
            "policy_kwargs": {"net_arch": [64, 64]},
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
            **SAC,
            "env": "TCATwistAlignDense-v0",
            "steps": 150_000,
            "policy_kwargs": {"net_arch": [128, 128]},
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
    "pick-and-place": {
        "sac": {
            **SAC,
            "env": "TCAPickAndPlaceDense-v0",
            "steps": 300_000,
            "policy_kwargs": {"net_arch": [256, 256]},
            "gamma": 0.99,
            "learning_starts": 10_000,
            "buffer_size": 300_000,
        },
        "ppo": {
            "env": "TCAPickAndPlaceDense-v0",
            "steps": 3_000_000,
            "envs": 8,
            "policy_kwargs": {"net_arch": [256, 256], "log_std_init": -0.5},
            "learning_rate": 3e-4,
            "n_steps": 600,
            "batch_size": 600,
            "n_epochs": 8,
            "gamma": 0.99,
            "gae_lambda": 0.95,
        },
        "dagger": {
            "env": "TCAPickAndPlaceDense-v0",
            "steps": 300_000,
            "envs": 10,
            "done_steps": 40,
            "controller": "pick-and-place",
            "policy_kwargs": {"net_arch": {"pi": [256, 256], "vf": [1]}},
            "learning_rate": decaying,
            "n_steps": 1_500,
            "batch_size": 500,
            "n_epochs": 12,
        },
    },
}
"""`env`, `steps` and `envs` are the environment, the default number of its steps and how many are stepped together,
`done_steps` ends training episodes whose goal has been held for so long; the rest goes to the learner."""
