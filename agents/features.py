"""What the networks are shown of an observation, where plain numbers make learning hard."""

from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from tca_envs.tasks import pick_and_place as layout


class PickAndPlaceFeatures(BaseFeaturesExtractor):
    """The observation of TCAPickAndPlace and differences that decide what to do next.

    Half a millimetre decides whether the jaws fit, on coordinates of centimetres: the ways from tool to object and from object
    to target are added in cm and, for the last millimetres, as tanh(d/2 mm), the former also across and along the jaws; so is
    twice the yaw between jaws and object.

    Parameters
    ----------
    observation_space : gymnasium.spaces.Dict
        Of the environment.
    """

    def __init__(self, observation_space: spaces.Dict) -> None:
        numbers = sum(int(space.shape[0]) for space in observation_space.values() if space.shape)
        super().__init__(observation_space, numbers + 2 * 8 + 2)

    def forward(self, observation: dict[str, Any]) -> torch.Tensor:
        """Return the features (N, k)."""
        seen, achieved, desired = (observation[key] for key in ("observation", "achieved_goal", "desired_goal"))
        c, s = seen[:, layout.TOOL_COS], seen[:, layout.TOOL_SIN]
        c2, s2 = seen[:, layout.OBJECT_COS2], seen[:, layout.OBJECT_SIN2]
        cosine, sine = c * c - s * s, 2.0 * c * s
        turn = (cosine * c2 + sine * s2, cosine * s2 - sine * c2)
        way = seen[:, layout.OBJECT] - seen[:, layout.TOOL]
        x, y = way[:, 0], way[:, 1]
        away = torch.cat(
            [
                way,
                torch.stack([c * x + s * y, c * y - s * x], dim=1),
                desired[:, :3] - achieved[:, :3],
            ],
            dim=1,
        )
        return torch.cat([seen, achieved, desired, away, torch.tanh(5.0 * away), torch.stack(turn, dim=1)], dim=1)
