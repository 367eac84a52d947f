"""Features of observations, the input of the networks.

The features of a task are a function of its observations as tensors (N, ...), named by the task's entry in
`tca_envs.registry`. It adds to the observation the differences on which the next action depends. Half a millimetre decides
where coordinates are centimetres, and networks are slow to learn the subtraction.
"""

from collections.abc import Callable

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from tca_envs import registry
from tca_envs.tasks import pick_and_place as layout

Observation = dict[str, torch.Tensor]

SHARPNESS = 5.0
"""Each difference d [cm] also enters as tanh(SHARPNESS d), which resolves the last two millimetres."""


class Features(BaseFeaturesExtractor):
    """The features of a task as a layer of Stable-Baselines3.

    Parameters
    ----------
    observation_space : gymnasium.spaces.Dict
        Of the environment.
    task : str, optional
        Its name, see `tca_envs.registry.entry`; without one, or where its entry names no features, `differences`.
    """

    def __init__(self, observation_space: spaces.Dict, task: str | None = None) -> None:
        named = registry.entry(task).features if task is not None else None
        shown: Callable[[Observation], torch.Tensor] = registry.load(named or differences)
        blank = {name: torch.zeros((1, *(space.shape or ()))) for name, space in observation_space.items()}
        super().__init__(observation_space, shown(blank).shape[1])
        self.shown = shown

    def forward(self, observation: Observation) -> torch.Tensor:
        """Return the features (N, k)."""
        return self.shown(observation)


def differences(observation: Observation) -> torch.Tensor:
    """Return the features (N, k) of any task with goals: the differences of desired and achieved goals are added."""
    return with_differences(observation, observation["desired_goal"] - observation["achieved_goal"])


reach = differences
"""Features of TCAReach: the difference of goal and tip is added."""


def twist_align(observation: Observation) -> torch.Tensor:
    """Return the features (N, k) of TCATwistAlign: the differences of positions and the sine of that of yaws are added."""
    achieved, desired = observation["achieved_goal"], observation["desired_goal"]
    sine = achieved[:, 3] * desired[:, 4] - achieved[:, 4] * desired[:, 3]
    return with_differences(observation, desired[:, :3] - achieved[:, :3], sine[:, None])


def pick_and_place(observation: Observation) -> torch.Tensor:
    """Return the features (N, k) of TCAPickAndPlace.

    The differences of tool and object, and of object and target, are added, the former also across and along the jaws, and
    cosine and sine of twice the yaw between jaws and object.
    """
    seen = observation["observation"]
    c, s = seen[:, layout.TOOL_COS], seen[:, layout.TOOL_SIN]
    c2, s2 = seen[:, layout.OBJECT_COS2], seen[:, layout.OBJECT_SIN2]
    cosine, sine = c * c - s * s, 2.0 * c * s
    turn = torch.stack((cosine * c2 + sine * s2, cosine * s2 - sine * c2), dim=1)
    to_object = seen[:, layout.OBJECT] - seen[:, layout.TOOL]
    x, y = to_object[:, 0], to_object[:, 1]
    in_jaws = torch.stack([c * x + s * y, c * y - s * x], dim=1)
    to_target = observation["desired_goal"][:, :3] - observation["achieved_goal"][:, :3]
    return torch.cat([with_differences(observation, to_object, in_jaws, to_target), turn], dim=1)


def with_differences(observation: Observation, *parts: torch.Tensor) -> torch.Tensor:
    """Return observation and goals, then the differences in `parts` (N, ...) [cm], then their sharp tanh."""
    away = torch.cat(parts, dim=1)
    seen = (observation[key] for key in ("observation", "achieved_goal", "desired_goal"))
    return torch.cat([*seen, away, torch.tanh(SHARPNESS * away)], dim=1)
