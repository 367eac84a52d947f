"""Gymnasium environments for a soft arm driven by heated twisted-and-coiled actuators. Importing registers their ids."""

import gymnasium

for _name, _task, _steps in (
    ("TCAReach", "reach", 100),
    ("TCATwistAlign", "twist-align", 100),
    ("TCAPickAndPlace", "pick-and-place", 300),
):
    for _suffix, _reward in (("", "sparse"), ("Dense", "dense")):
        gymnasium.register(
            id=f"{_name}{_suffix}-v0",
            entry_point="tca_envs.env:ArmEnv",
            vector_entry_point="tca_envs.vector:ArmVectorEnv",
            max_episode_steps=_steps,
            kwargs={"task": _task, "reward": _reward},
        )
