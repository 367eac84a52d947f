"""Training, evaluation and films of policies, and the folders that hold them: what `train.py` does."""

import json
import platform
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium

from agents.evaluate import Policy, Report, evaluate, lanes_for
from agents.hyperparameters import ALGORITHMS, for_learner, settings_of
from agents.scripted import RandomPolicy, controller_of
from tca_envs import registry

EVALUATION_SEED = 1_000_000
"""Held-out goals are drawn with seeds from here on."""
PRETRAINED = Path(__file__).parent / "pretrained"
"""Holds the folder of a trained policy for each task."""
ENGINES = ("sb3", "ray")
ARTEFACTS = (
    "policy.zip", "policy.json", "last.zip", "replay_buffer.pkl", "curve.csv", "curve.png", "report.json", "evaluation.json",
    "events.out.tfevents.*",
)  # fmt: skip
"""Files of a run's folder, as patterns."""
FILMED_EPISODES = 3
CURVE_SEED = 2_000_000
"""Goals of the learning curve, of the training split, are drawn with seeds from here on."""
CURVE_EPISODES = 30
CURVE_POINTS = 12
CURVE_INTERVAL = 2_000
"""Least number of steps between points of the learning curve: one costs 3,000 steps of evaluation."""


class RunError(ValueError):
    """A run cannot be started or read; the message says why."""


class Interrupted(KeyboardInterrupt):
    """Ctrl-C ended the training; the run can be resumed."""


@dataclass(frozen=True)
class Job:
    """A training: task, algorithm, settings, and the machine's share in it."""

    task: str
    """Its name, or "module:name", see `tca_envs.registry.entry`."""
    algorithm: str
    settings: dict[str, Any]
    """See `agents.hyperparameters`."""
    seed: int = 0
    """Of everything random."""
    engine: str = "sb3"
    """One of ENGINES."""
    device: str = "cpu"
    """Of torch."""
    threads: int = 1
    """Of torch: the networks are small."""
    workers: int = 1
    """Processes that step environments, with the engine ray."""

    @property
    def name(self) -> str:
        """Name of the run's folder."""
        return f"{registry.entry(self.task).name}-{self.algorithm}{'-ray' if self.engine == 'ray' else ''}-seed{self.seed}"


def run(job: Job, folder: Path, steps: int | None, episodes: int, resume: bool = False) -> Any:
    """Train, keep the best policy in `folder`, and compare it with the scripted controller and a random policy.

    Parameters
    ----------
    job : Job
        The training.
    folder : pathlib.Path
        Of the run; files of an earlier run are removed unless `resume`.
    steps : int, optional
        Environment steps to train, with `resume` in addition. By default the missing steps of a run that was cut short, else
        the settings' `n_timesteps`.
    episodes : int
        Held-out episodes to evaluate.
    resume : bool
        Whether to continue the run in `folder`.

    Returns
    -------
    Stable-Baselines3 model
        The policy kept.

    Raises
    ------
    RunError
        If `folder` holds nothing to resume.
    Interrupted
        If Ctrl-C ended the training.
    """
    set_threads(job.threads)
    if resume:
        model = load(job, folder / "last.zip")
        buffer = folder / "replay_buffer.pkl"
        if buffer.exists():
            model.load_replay_buffer(buffer)
    else:
        model = build(job)
        folder.mkdir(parents=True, exist_ok=True)
        clear(folder)
    seconds, interrupted = train(job, model, folder, steps, resume)
    print(f"saved the policy, curve.csv and curve.png in {folder}")
    if interrupted:
        raise Interrupted(f"interrupted after {model.num_timesteps} steps")
    model = load(job, folder / "policy.zip")
    write_report(job, model, folder / "report.json", episodes, seconds)
    return model


def run_seeds(job: Job, seeds: Sequence[int], parent: Path, steps: int | None, episodes: int) -> list[Report]:
    """Run with each of the seeds on a Ray cluster, as many at a time as it has processors for; parameters as of `run`.

    Folders lie in `parent`. Returns the reports of the policies on held-out goals, in the order of the seeds.
    """
    from agents.ray_engine import run_trials

    parent = parent.absolute()

    def trial(seed: int) -> dict[str, Any]:
        one = replace(job, seed=seed)
        run(one, parent / one.name, steps, episodes)
        report: dict[str, Any] = json.loads((parent / one.name / "report.json").read_text())
        return report["held_out"][job.algorithm]

    return [Report(**found) for found in run_trials(trial, seeds, job.workers)]


def set_threads(threads: int) -> None:
    """Set the number of threads of torch."""
    import torch

    torch.set_num_threads(threads)


def read_description(folder: Path) -> dict[str, Any]:
    """Return the description of the policy in a run's folder: the contents of `policy.json`.

    Raises
    ------
    RunError
        If it is no such folder, or its task or algorithm is unknown.
    """
    path = folder / "policy.json"
    try:
        description = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise RunError(f"{folder}: expected the folder of a run, with policy.zip and policy.json ({error})") from None
    if not isinstance(description, dict):
        raise RunError(f"{path}: expected an object with task and algo")
    task, algorithm = str(description.get("task")), description.get("algo")
    try:
        known = settings_of(task)
    except (ValueError, ImportError):
        known = {}
    if algorithm not in known:
        tasks = ", ".join(entry.name for entry in registry.entries())
        known_ones = f"the tasks are {tasks}, the algorithms {', '.join(ALGORITHMS)}"
        raise RunError(f"{path}: task {task!r} with {algorithm!r} is unknown; {known_ones}")
    return description


def pretrained(task: str) -> Policy:
    """Return the trained policy of a task that is part of the repository; RunError if there is none."""
    from agents import policies

    folder = PRETRAINED / registry.entry(task).name
    policy: Policy = policies.learner(read_description(folder)["algo"]).load(folder / "policy.zip", device="cpu")
    return policy


def learner(job: Job) -> Any:
    """Return the class of a job's algorithm for its engine."""
    if job.engine == "ray":
        from agents.ray_engine import RayPPO

        return RayPPO
    from agents import policies

    return policies.learner(job.algorithm)


def environments(settings: dict[str, Any], seed: int) -> Any:
    """Return the batch of training environments."""
    from stable_baselines3.common.vec_env import VecMonitor

    from agents.sb3 import make

    return VecMonitor(make(settings["env"], settings["n_envs"], seed, settings.get("done_steps")))


def clear(folder: Path) -> None:
    """Remove the files of an earlier run from a folder."""
    for path in [path for pattern in ARTEFACTS for path in folder.glob(pattern)]:
        path.unlink()


def build(job: Job) -> Any:
    """Return a fresh model."""
    options = for_learner(job.settings)
    if job.engine == "ray":
        options |= {"env_id": job.settings["env"], "workers": job.workers}
    return learner(job)(env=environments(job.settings, job.seed), seed=job.seed, device=job.device, **options)


def load(job: Job, path: Path) -> Any:
    """Return a saved model; RunError if the file holds none or one for other spaces."""
    if not path.exists():
        raise RunError(f"{path}: not there; a run that ended before its first checkpoint has to start again")
    # Hindsight asks an environment for rewards and is not read without one.
    hindsight = {"env": environments(job.settings, job.seed)} if "replay_buffer_class" in job.settings else {}
    try:
        model = learner(job).load(path, device=job.device, **hindsight)
    except Exception as error:  # SB3 passes on whatever torch, pickle and zipfile raise
        raise RunError(
            f"{path}: expected a {job.algorithm} policy that this version of stable-baselines3 reads ({error})"
        ) from error
    # As many environments as it was trained with, and new goals.
    env = environments({**job.settings, "n_envs": model.n_envs}, job.seed + model.num_timesteps)
    for name in ("observation_space", "action_space"):
        if getattr(model, name) != getattr(env, name):
            made_for, has = getattr(model, name), getattr(env, name)
            raise RunError(f"{path}: made for the {name} {made_for}, but {job.settings['env']} has {has}")
    model.set_env(env)
    if job.engine == "ray":
        model.workers = job.workers
    return model


def train(
    job: Job, model: Any, folder: Path, steps: int | None, resume: bool = False, progress_bar: bool = True
) -> tuple[float, bool]:
    """Train, save and draw the learning curve; returns the seconds taken and whether Ctrl-C ended it.

    The policy kept is the one that came nearest to the curve's goals. These are of the training split, so that the held-out
    goals stay unseen until the end. Parameters as of `run`.
    """
    from stable_baselines3.common.logger import configure

    from agents.curve import Curve

    settings = job.settings
    left = read_description(folder).get("steps", 0) - model.num_timesteps if resume else 0
    steps = steps or (left if left > 0 else settings["n_timesteps"])
    print(f"training {job.algorithm} on {settings['env']} for {steps} steps, seed {job.seed}, into {folder}")
    description = {
        "task": job.task,
        "algo": job.algorithm,
        "engine": job.engine,
        "seed": job.seed,
        "env": settings["env"],
        "steps": model.num_timesteps + steps,
        "versions": versions(job.engine),
    }
    (folder / "policy.json").write_text(json.dumps(description, indent=2) + "\n")
    model.set_logger(configure(str(folder), ["tensorboard"] if find_spec("tensorboard") else []))
    env = gymnasium.make_vec(settings["env"], CURVE_EPISODES)
    curve = Curve(folder, env, CURVE_EPISODES, CURVE_SEED, max(CURVE_INTERVAL, steps // CURVE_POINTS), resume)
    interrupted = False
    try:
        model.learn(steps, callback=curve, reset_num_timesteps=False, progress_bar=progress_bar)
    except KeyboardInterrupt:
        interrupted = True
        curve.save()
    return curve.seconds, interrupted


def compare(job: Job, model: Any, episodes: int) -> dict[str, Report]:
    """Return the reports of the policy, the task's controller if it has one, and a random policy on the same held-out goals."""
    from tqdm import tqdm

    env = gymnasium.make_vec(job.settings["env"], lanes_for(episodes), split="held-out")
    policies: dict[str, Policy] = {job.algorithm: model}
    controller = controller_of(job.task)
    if controller is not None:
        policies["scripted"] = controller
    policies["random"] = RandomPolicy(model.action_space.shape[0])
    reports = {}
    for name, policy in policies.items():
        with tqdm(total=episodes, desc=f"{name} on held-out goals", leave=False) as bar:
            reports[name] = evaluate(policy, env, episodes, EVALUATION_SEED, lambda done: bar.update(done - bar.n))
    for name, report in reports.items():
        print(f"{name:>9}: {report}")
    return reports


def write_report(job: Job, model: Any, path: Path, episodes: int, seconds: float = 0.0) -> None:
    """Compare a policy with others and write the report; `seconds` is the duration of its training."""
    reports = compare(job, model, episodes)
    report = {
        **describe(job, model, seconds),
        "evaluation_seed": EVALUATION_SEED,
        "held_out": {name: asdict(found) for name, found in reports.items()},
    }
    path.write_text(json.dumps(report, indent=2) + "\n")
    print(f"wrote {path}")


def describe(job: Job, model: Any, seconds: float) -> dict[str, Any]:
    """Return the part of a report that describes a policy and its training."""
    return {
        "task": job.task,
        "algo": job.algorithm,
        "env": job.settings["env"],
        "seed": job.seed,
        "policy_steps": model.num_timesteps,
        "training_seconds": round(seconds, 1),
        "versions": versions(job.engine),
    }


def film(job: Job, policy: Policy, path: Path) -> None:
    """Write a video of the first held-out episodes."""
    from agents.video import frames, save

    with closing(gymnasium.make(job.settings["env"], split="held-out", render_mode="rgb_array")) as env:
        save(frames(policy, env, FILMED_EPISODES, EVALUATION_SEED), path, env.metadata["render_fps"])
    print(f"wrote {path}")


def versions(engine: str) -> dict[str, str]:
    """Return the versions of Python and the packages that train a policy."""
    names = ["tca_envs", "gymnasium", "stable_baselines3", "torch", "numpy", "numba"]
    if engine == "ray":
        names.append("ray")
    return {"python": platform.python_version(), **{name: version(name) for name in names}}
