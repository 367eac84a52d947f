"""DAgger: a policy imitates a scripted controller in the states that the policy itself visits.

S. Ross, G. Gordon and D. Bagnell, "A reduction of imitation learning and structured prediction to no-regret online learning",
AISTATS 2011. The controller acts in the first rounds, the policy in later ones. The controller's actions are recorded in all
of them, and after every round the policy is fitted to the whole record.
"""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.type_aliases import MaybeCallback

from agents.scripted import controller_of
from tca_envs import registry

EXPERT_STEPS = 30_000
"""Steps in which the controller acts before the policy takes over."""
Observations = dict[str, NDArray[np.float32]]


class DAgger(PPO):
    """The networks of PPO, saved and loaded like PPO's, fitted to a scripted controller.

    Parameters
    ----------
    policy, env, **options
        As of Stable-Baselines3's `PPO`; `n_steps` are the steps of each environment in a round, `n_epochs` the passes
        over the record after it.
    controller : str
        The task whose controller is imitated, see `tca_envs.registry.entry`; only a policy that learns no more needs none.

    Raises
    ------
    ValueError
        If there is no such task or it has no controller, or if there is none to learn from.
    """

    def __init__(self, policy: Any, env: Any, controller: str | None = None, **options: Any) -> None:
        if controller is not None:
            teacher(controller)
        self.controller = controller
        self.record: list[tuple[Observations, NDArray[np.float32]]] = []
        options["policy_kwargs"] = {"activation_fn": torch.nn.ReLU, **(options.get("policy_kwargs") or {})}
        super().__init__(policy, env, **options)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "record"]

    def save_replay_buffer(self, path: Path) -> None:
        """Save the record, which resuming needs."""
        Path(path).write_bytes(pickle.dumps(self.record))

    def load_replay_buffer(self, path: Path) -> None:
        """Load a record that `save_replay_buffer` saved."""
        self.record = pickle.loads(Path(path).read_bytes())

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "DAgger",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> "DAgger":
        """Train for `total_timesteps` more steps; see `BaseAlgorithm.learn`."""
        total_timesteps, callbacks = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        assert self.env is not None
        expert = teacher(self.controller)
        callbacks.on_training_start(locals(), globals())
        observation: Any = self._last_obs
        running = True
        while running and self.num_timesteps < total_timesteps:
            by_expert = self.num_timesteps < EXPERT_STEPS
            for _ in range(self.n_steps):
                wanted, _ = expert.predict(observation)
                self.record.append(({key: value.copy() for key, value in observation.items()}, wanted))
                action = wanted if by_expert else self.predict(observation, deterministic=True)[0]
                observation, _, dones, infos = self.env.step(action)
                self._update_info_buffer(infos, dones)
                self._last_obs = observation
                self.num_timesteps += self.env.num_envs
                running = callbacks.on_step()
                if not running or self.num_timesteps >= total_timesteps:
                    break
            self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
            self._fit()
            self.dump_logs()
        callbacks.on_training_end()
        return self

    def _fit(self) -> None:
        """Fit the mean action to the record by least squares."""
        keys = self.record[0][0].keys()
        seen = {key: torch.as_tensor(np.concatenate([o[key] for o, _ in self.record]), device=self.device) for key in keys}
        wanted = torch.as_tensor(np.concatenate([a for _, a in self.record]), device=self.device)
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        generator = torch.Generator().manual_seed(self.num_timesteps + (self.seed or 0))
        for _ in range(self.n_epochs):
            for batch in torch.randperm(len(wanted), generator=generator).split(self.batch_size):
                distribution = self.policy.get_distribution({key: value[batch] for key, value in seen.items()})
                loss = torch.nn.functional.mse_loss(distribution.mode(), wanted[batch])
                self.policy.optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
                self.policy.optimizer.step()
        self.policy.set_training_mode(False)
        self.logger.record("train/loss", loss.item())


def teacher(task: str | None) -> Any:
    """Return the controller of a task; ValueError if there is none."""
    known = [entry.name for entry in registry.entries() if entry.controller is not None]
    if task is None or (":" not in task and task not in known) or (found := controller_of(task)) is None:
        raise ValueError(f"controller = {task!r}: expected one of {', '.join(map(repr, known))} to learn from")
    return found
