"""Policies of Stable-Baselines3 whose networks get `agents.features.Features`, and learners by name."""

from typing import Any

from stable_baselines3.common.policies import MultiInputActorCriticPolicy
from stable_baselines3.sac.policies import MultiInputPolicy

from agents.features import Features


class ActorCritic(MultiInputActorCriticPolicy):
    """The policy of PPO and DAgger."""

    def __init__(self, *spaces: Any, **options: Any) -> None:
        super().__init__(*spaces, **{"features_extractor_class": Features, **options})


class SoftActorCritic(MultiInputPolicy):
    """The policy of SAC."""

    def __init__(self, *spaces: Any, **options: Any) -> None:
        super().__init__(*spaces, **{"features_extractor_class": Features, **options})


def learner(algorithm: str) -> Any:
    """Return the class of an algorithm: Stable-Baselines3's or one with its interface. HER is SAC with another buffer."""
    import stable_baselines3

    from agents.dagger import DAgger

    own = {"dagger": DAgger, "her": stable_baselines3.SAC}
    return own[algorithm] if algorithm in own else getattr(stable_baselines3, algorithm.upper())
