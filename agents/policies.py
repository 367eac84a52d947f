"""Policies of Stable-Baselines3 whose networks are shown `agents.features.Features`: as its own otherwise."""

from typing import Any

from stable_baselines3.common.policies import MultiInputActorCriticPolicy
from stable_baselines3.sac.policies import MultiInputPolicy

from agents.features import Features


class ActorCritic(MultiInputActorCriticPolicy):
    """Of PPO and DAgger."""

    def __init__(self, *spaces: Any, **options: Any) -> None:
        super().__init__(*spaces, **{"features_extractor_class": Features, **options})


class SoftActorCritic(MultiInputPolicy):
    """Of SAC."""

    def __init__(self, *spaces: Any, **options: Any) -> None:
        super().__init__(*spaces, **{"features_extractor_class": Features, **options})
