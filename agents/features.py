"""What the networks are shown of an observation, where plain numbers make learning hard."""

from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from tca_envs.tasks import pick_and_place as layout

SHARPNESS = 5.0
"""Ways are shown as tanh of so many times their length in cm, too: the last two millimetres decide."""


class Features(BaseFeaturesExtractor):
    """The observation of a task and what decides what to do next: the ways that are left, in cm and sharply.

    Half a millimetre decides on coordinates of centimetres, and networks learn slowly to subtract them. Of TCAReach the way
    from tip to goal is added, of TCATwistAlign that and the sine of the yaw left, of TCAPickAndPlace the ways from tool to
    object and from object to target, the former also across and along the jaws, and cosine and sine of twice the yaw between
    jaws and object.

    Parameters
    ----------
    observation_space : gymnasium.spaces.Dict
        Of the environment.
    """

    def __init__(self, observation_space: spaces.Dict) -> None:
        blank = {name: torch.zeros((1, *(space.shape or ()))) for name, space in observation_space.items()}
        super().__init__(observation_space, shown(blank).shape[1])

    def forward(self, observation: dict[str, Any]) -> torch.Tensor:
        """Return the features (N, k)."""
        return shown(observation)


def shown(observation: dict[str, Any]) -> torch.Tensor:
    """Return the features (N, k) of observations of any task, which is told by the size of its goals."""
    seen, achieved, desired = (observation[key] for key in ("observation", "achieved_goal", "desired_goal"))
    parts = [desired[:, :3] - achieved[:, :3]]
    turn = []
    if desired.shape[1] == 5:
        parts.append((achieved[:, 3] * desired[:, 4] - achieved[:, 4] * desired[:, 3])[:, None])
    elif desired.shape[1] == 4:
        c, s = seen[:, layout.TOOL_COS], seen[:, layout.TOOL_SIN]
        c2, s2 = seen[:, layout.OBJECT_COS2], seen[:, layout.OBJECT_SIN2]
        cosine, sine = c * c - s * s, 2.0 * c * s
        turn = [torch.stack((cosine * c2 + sine * s2, cosine * s2 - sine * c2), dim=1)]
        way = seen[:, layout.OBJECT] - seen[:, layout.TOOL]
        x, y = way[:, 0], way[:, 1]
        parts = [way, torch.stack([c * x + s * y, c * y - s * x], dim=1), *parts]
    away = torch.cat(parts, dim=1)
    return torch.cat([seen, achieved, desired, away, torch.tanh(SHARPNESS * away), *turn], dim=1)
