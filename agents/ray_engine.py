"""PPO with workers on several cores or machines, by Ray RLlib.

A worker steps one native batch of environments and sends whole pieces of episodes. The learner, one process, updates the
networks of Stable-Baselines3's PPO and sends them back. Models are saved as Stable-Baselines3's PPO saves them, so that
evaluating them needs no Ray.
"""

import logging
import os
import shutil
import socket
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import gymnasium
import numpy as np
import ray
import torch
from numpy.typing import NDArray
from ray import tune
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.columns import Columns
from ray.rllib.core.distribution.torch.torch_distribution import TorchDiagGaussian
from ray.rllib.core.rl_module.apis import ValueFunctionAPI
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.env.utils.infinite_lookback_buffer import InfiniteLookbackBuffer
from stable_baselines3 import PPO
from stable_baselines3.common.type_aliases import MaybeCallback

import tca_envs  # noqa: F401  (registers the environments, in the workers' processes, too)

SCHEDULE_POINTS = 20
"""RLlib gets a learning rate that changes as a piecewise linear function with so many pieces."""
OBJECT_STORE_BYTES = 256 * 2**20
"""Size of a local cluster's object store; a batch of half a million steps takes half of it."""


class Networks(TorchRLModule, ValueFunctionAPI):
    """The networks of a policy of Stable-Baselines3 as a module of RLlib.

    `model_config` has the policy's class ("policy_class"), its arguments ("policy_kwargs") and initial weights ("weights").
    """

    def setup(self) -> None:
        """Build the networks."""
        made = self.model_config
        self.policy = made["policy_class"](self.observation_space, self.action_space, lambda _: 0.0, **made["policy_kwargs"])
        self.policy.load_state_dict(made["weights"])
        self.action_dist_cls = TorchDiagGaussian

    def _forward(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        gaussian = self.policy.get_distribution(batch[Columns.OBS]).distribution
        return {Columns.ACTION_DIST_INPUTS: torch.cat([gaussian.mean, gaussian.stddev.log()], dim=-1)}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> torch.Tensor:
        """Return the values (n,) of the batch's observations."""
        return self.policy.predict_values(batch[Columns.OBS]).squeeze(-1)


class BatchRunner(SingleAgentEnvRunner):
    """A worker that steps its environments as one batch; RLlib's own loops over them in Python at every step."""

    def make_env(self) -> None:
        """Make the batch of environments."""
        self.env: Any = gymnasium.make_vec(self.config.env, self.config.num_envs_per_env_runner, **self.config.env_config)
        self.num_envs = self.env.num_envs
        space: Any = self.env.single_action_space
        self.low, self.high = space.low, space.high
        self._needs_initial_reset = True
        self._return, self._length = np.zeros(self.num_envs), np.zeros(self.num_envs, dtype=int)

    def _sample(
        self,
        *,
        num_timesteps: int,
        num_episodes: int | None = None,
        explore: bool,
        random_actions: bool = False,
        force_reset: bool = False,
    ) -> list[SingleAgentEpisode]:
        """Step at least `num_timesteps` times; the other arguments are RLlib's and not used."""
        if self._needs_initial_reset:
            self._now, _ = self.env.reset(seed=self._seed)
            self._over = np.zeros(self.num_envs, dtype=bool)
            self._needs_initial_reset = False
        steps, taken, episodes = [], 0, 0
        while taken < num_timesteps:
            seen = {key: torch.as_tensor(value) for key, value in self._now.items()}
            inputs = self.module.forward_exploration({Columns.OBS: seen})[Columns.ACTION_DIST_INPUTS]
            gaussian = TorchDiagGaussian.from_logits(inputs)
            action = gaussian.sample()
            extra = {Columns.ACTION_DIST_INPUTS: inputs.numpy(), Columns.ACTION_LOGP: gaussian.logp(action).numpy()}
            after, reward, terminated, truncated, _ = self.env.step(np.clip(action.numpy(), self.low, self.high))
            steps.append((self._now, action.numpy(), reward, terminated, truncated, ~self._over, extra))
            taken += self.num_envs - int(self._over.sum())
            self._return, self._length = self._return + reward, self._length + 1
            self._return[self._over], self._length[self._over] = 0.0, 0  # that step was the reset
            self._now, self._over = after, terminated | truncated
            for i in np.flatnonzero(self._over):
                self._log_episode_metrics(int(self._length[i]), float(self._return[i]), 0.0)
                episodes += 1
        self._increase_sampled_metrics(taken, episodes)
        self.num_env_steps_sampled_lifetime += taken
        return cut(steps, self._now)


def cut(steps: list[Any], last: dict[str, NDArray[Any]]) -> list[SingleAgentEpisode]:
    """Return the pieces of episodes in a record of a batch of N environments.

    Parameters
    ----------
    steps : list of tuple
        At every step: observations before it, actions, rewards, terminated, truncated, whether it was a step rather than the
        reset after the end of an episode (N,), and outputs of the networks.
    last : dict
        Observations after the last step.
    """
    observations, actions, rewards, terminated, truncated, real, extras = zip(*steps, strict=True)
    seen = {key: np.stack([o[key] for o in (*observations, last)], axis=1) for key in last}
    said = {key: np.stack([e[key] for e in extras], axis=1) for key in extras[0]}
    action, reward, terminal, cut_off, valid = (np.stack(a, axis=1) for a in (actions, rewards, terminated, truncated, real))
    reward = reward.astype(np.float32)
    found = []
    for i, lane in enumerate(valid):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], lane, [False]]).astype(np.int8)))
        for start, stop in edges.reshape(-1, 2):
            part = (i, slice(start, stop))
            found.append(
                SingleAgentEpisode(
                    observations=InfiniteLookbackBuffer({key: value[i, start : stop + 1] for key, value in seen.items()}),
                    infos=InfiniteLookbackBuffer([{}] * (stop - start + 1)),
                    actions=InfiniteLookbackBuffer(action[part]),
                    rewards=InfiniteLookbackBuffer(reward[part]),
                    terminated=bool(terminal[i, stop - 1]),
                    truncated=bool(cut_off[i, stop - 1]),
                    extra_model_outputs={key: InfiniteLookbackBuffer(value[part]) for key, value in said.items()},
                    len_lookback_buffer=0,
                )
            )
    return found


class RayPPO(PPO):
    """PPO whose steps and updates RLlib makes; saved and loaded like Stable-Baselines3's.

    Parameters
    ----------
    policy, env, **options
        As of Stable-Baselines3's `PPO`. `env` gives the spaces and the number of environments, which the workers divide among
        them; it is not stepped.
    env_id : str
        Id of the environments that the workers make.
    workers : int
        How many processes step environments, on the `cluster` in which `learn` is called or on this machine.

    Raises
    ------
    ValueError
        For an option that RLlib's PPO does not have.
    """

    def __init__(self, policy: Any, env: Any, env_id: str = "", workers: int = 1, **options: Any) -> None:
        super().__init__(policy, env, **options)
        self.env_id, self.workers = env_id, workers
        for name, plain in (("clip_range_vf", None), ("target_kl", None), ("use_sde", False), ("normalize_advantage", True)):
            if getattr(self, name) != plain:
                raise ValueError(f"{name} = {getattr(self, name)!r}: expected {plain!r}, RLlib's PPO has no other")

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "workers"]  # belongs to the machine, not to the model

    def config(self, steps: int) -> PPOConfig:
        """Return the settings as RLlib's, to train the model for `steps` more steps.

        Raises
        ------
        ValueError
            If `clip_range` is a schedule, which RLlib's PPO does not have.
        """
        clip: Any = self.clip_range  # a function once the model is set up
        if clip(0.0) != clip(1.0):
            raise ValueError(f"clip_range = {clip!r}: expected a constant, RLlib's PPO has no other")
        done, total = self.num_timesteps, self.num_timesteps + steps
        fractions = np.linspace(0.0, 1.0, SCHEDULE_POINTS + 1)
        rates = [[int(part * steps), float(self.lr_schedule(1.0 - (done + part * steps) / total))] for part in fractions]
        weights = {key: value.cpu() for key, value in self.policy.state_dict().items()}
        module = RLModuleSpec(
            module_class=Networks,
            model_config={"policy_class": self.policy_class, "policy_kwargs": self.policy_kwargs, "weights": weights},
        )
        return (
            PPOConfig()
            .environment(
                self.env_id,
                env_config={"threads": 1},  # a worker is a processor
                observation_space=self.observation_space,
                action_space=self.action_space,
            )
            .env_runners(
                env_runner_cls=BatchRunner,
                num_env_runners=self.workers,
                num_envs_per_env_runner=-(-self.n_envs // self.workers),
            )
            .rl_module(rl_module_spec=module)
            .training(
                lr=rates if len({rate for _, rate in rates}) > 1 else rates[0][1],
                train_batch_size_per_learner=self.n_steps * self.n_envs,
                minibatch_size=self.batch_size,
                num_epochs=self.n_epochs,
                gamma=self.gamma,
                lambda_=self.gae_lambda,
                clip_param=clip(1.0),
                vf_clip_param=float("inf"),
                vf_loss_coeff=self.vf_coef,
                entropy_coeff=self.ent_coef,
                use_kl_loss=False,
                grad_clip=self.max_grad_norm,
                grad_clip_by="global_norm",
            )
            .debugging(seed=self.seed, log_level="ERROR")
        )

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "RayPPO",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> "RayPPO":
        """Train until `total_timesteps` more steps are done; see `BaseAlgorithm.learn`."""
        total, callbacks = self._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        with cluster(None, self.workers):
            algorithm = self.config(total - self.num_timesteps).build_algo()
            try:
                self._iterate(algorithm, total, callbacks)
            finally:
                algorithm.stop()
                shutil.rmtree(algorithm.logdir, ignore_errors=True)
        return self

    def _iterate(self, algorithm: Any, total: int, callbacks: Any) -> None:
        optimizer = self.policy.optimizer.state_dict()
        algorithm.learner_group.foreach_learner(lambda learner: optimizers(learner)[0].load_state_dict(optimizer))
        callbacks.on_training_start({"total_timesteps": total}, {})
        going_on = True
        while going_on and self.num_timesteps < total:
            result = algorithm.train()
            taken = int(result["env_runners"]["num_env_steps_sampled"])
            (learnt,) = algorithm.learner_group.foreach_learner(
                lambda learner: (learner.module["default_policy"].policy.state_dict(), optimizers(learner)[0].state_dict())
            )
            weights, optimizer = learnt.get()
            self.policy.load_state_dict(weights)
            self.policy.optimizer.load_state_dict(optimizer)
            self._log(result)
            for count in (*[self.n_envs] * (taken // self.n_envs), taken % self.n_envs):
                self.num_timesteps += count
                going_on = going_on and callbacks.on_step()
        callbacks.on_training_end()

    def _log(self, result: dict[str, Any]) -> None:
        episodes, learner = result["env_runners"], result["learners"]["default_policy"]
        for name, key in (("ep_rew_mean", "episode_return_mean"), ("ep_len_mean", "episode_len_mean")):
            if np.isfinite(episodes.get(key, np.nan)):  # some have ended
                self.logger.record(f"rollout/{name}", float(episodes[key]))
        for name in ("total_loss", "policy_loss", "vf_loss", "entropy", "vf_explained_var"):
            self.logger.record(f"train/{name}", float(learner[name]))
        self.logger.dump(self.num_timesteps)


def optimizers(learner: Any) -> list[torch.optim.Optimizer]:
    """Return the optimizers of one of RLlib's learners."""
    return [optimizer for _, optimizer in learner.get_optimizers_for_module("default_policy")]


@contextmanager
def cluster(address: str | None, processors: int) -> Iterator[None]:
    """Connect to a Ray cluster for a `with` statement; within another one it does nothing.

    Parameters
    ----------
    address : str, optional
        HOST:PORT of a running cluster, or "auto" for the one that this machine is part of; by default one is started on this
        machine and stopped afterwards.
    processors : int
        How many are needed.

    Raises
    ------
    ConnectionError
        If there is no cluster at the address.
    ValueError
        If the cluster has fewer processors, for which Ray would wait forever.
    """
    if ray.is_initialized():
        yield
        return
    if address not in (None, "auto"):
        host, _, port = address.rpartition(":")
        try:
            socket.create_connection((host, int(port)), timeout=10).close()  # Ray itself would try for many minutes
        except (OSError, ValueError) as error:
            raise ConnectionError(f"address = {address!r}: expected HOST:PORT of a Ray cluster, or 'auto' ({error})") from None
    logging.getLogger("ray.rllib").setLevel(logging.ERROR)
    quiet: dict[str, Any] = {"logging_level": logging.ERROR, "log_to_driver": False}
    if address is None:
        ray.init("local", num_cpus=processors, include_dashboard=False, object_store_memory=OBJECT_STORE_BYTES, **quiet)
    else:
        ray.init(address, **quiet)
    try:
        found = int(ray.cluster_resources().get("CPU", 0))
        if found < processors:
            raise ValueError(f"processors = {processors}: expected at most {found}, all that the cluster has")
        yield
    finally:
        ray.shutdown()


class Progress(tune.Callback):
    """Print a line after every trial."""

    def on_trial_complete(self, iteration: int, trials: list[Any], trial: Any, **_: Any) -> None:
        """See `ray.tune.Callback`."""
        print(f"the trial with {trial.config['setting']} is done")


def run_trials(trial: Callable[[Any], dict[str, Any]], settings: Sequence[Any], workers: int) -> list[dict[str, Any]]:
    """Run a trial with each of some settings by Ray Tune, within `cluster`, as many at a time as that has processors for.

    Parameters
    ----------
    trial : callable
        Trains with one of the settings and returns its results. It runs in a process of its own on this machine, where its
        files belong; its workers run anywhere.
    settings : sequence
        One for each trial.
    workers : int
        Of each trial.

    Returns
    -------
    list of dict
        Results of the trials, in the order of the settings.

    Raises
    ------
    RuntimeError
        If a trial fails; the others are finished first.
    """
    here = f"node:{ray.util.get_node_ip_address()}"
    places = tune.PlacementGroupFactory([{"CPU": 1, here: 0.001}, *[{"CPU": 1}] * workers])

    def go(config: dict[str, Any]) -> None:
        tune.report({"outcome": trial(config["setting"])})

    os.environ.setdefault("RAY_AIR_NEW_OUTPUT", "0")  # whose head points to a folder that is gone in the end
    with tempfile.TemporaryDirectory() as scratch:
        results = tune.Tuner(
            tune.with_resources(go, places),
            param_space={"setting": tune.grid_search(list(settings))},
            run_config=tune.RunConfig(storage_path=scratch, verbose=0, callbacks=[Progress()]),
        ).fit()
    for result in results:
        if result.error is not None:
            raise RuntimeError(f"the trial with {result.config['setting']} failed") from result.error
        if "outcome" not in (result.metrics or {}):  # Tune stops, but says nothing, when Ctrl-C is pressed
            raise KeyboardInterrupt
    return [result.metrics["outcome"] for result in results]
