"""Train a policy on a task, evaluate it on held-out goals beside a scripted controller and a random policy, and save it.

python train.py [--task reach] [--algo sac] [--steps N] [--seed S]      train and evaluate
python train.py --resume runs/reach-sac-seed0                           go on with a run
python train.py --eval-only runs/reach-sac-seed0                        evaluate a run
python train.py --engine ray [--workers N] [--address A] [--seeds S S]  PPO by Ray RLlib, on several cores or machines
"""

import argparse
import csv
import json
import platform
import sys
import time
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

import gymnasium

import tca_envs  # noqa: F401  (registers the environments)
from agents.evaluate import Policy, Report, evaluate
from agents.hyperparameters import ALGORITHMS, DEFAULT_ALGORITHM, HYPERPARAMETERS
from agents.scripted import CONTROLLERS, RandomPolicy

EVALUATION_SEED = 1_000_000
"""Held-out goals are drawn with seeds from here on."""
ARTEFACTS = (
    "policy.zip", "policy.json", "last.zip", "replay_buffer.pkl", "curve.csv", "curve.png", "report.json", "evaluation.json",
)  # fmt: skip
CURVE_SEED = 2_000_000
"""Goals of the learning curve, of the training split, are drawn with seeds from here on."""
CURVE_EPISODES = 30
CURVE_POINTS = 12
CURVE_INTERVAL = 2_000
"""Points of the learning curve lie at least this many steps apart: one costs 3,000 steps of evaluation."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    options = parse(arguments)
    return run_seeds(options) if options.seeds else run(options)


def run(options: argparse.Namespace) -> int:
    """Train or evaluate as asked; returns the exit status."""
    source = options.eval_only or options.resume
    task, algorithm, engine = options.task, options.algo, options.engine
    if source is not None:
        description = read_description(source)
        task = description["task"]
        if options.task is not None and options.task != task:
            fail(f"{source} holds a policy for the task {task!r}, not {options.task!r}")
        if algorithm is not None and algorithm != description["algo"]:
            fail(f"{source} holds a policy of {description['algo']!r}, not {algorithm!r}")
        algorithm = description["algo"]
        options.seed = description.get("seed", options.seed)
        engine = description.get("engine", engine)
    task = task or "reach"
    algorithm = algorithm or ("ppo" if engine == "ray" else DEFAULT_ALGORITHM[task])
    if algorithm not in HYPERPARAMETERS[task]:
        fail(f"--algo {algorithm}: not for the task {task!r}, whose algorithms are {', '.join(HYPERPARAMETERS[task])}")
    if engine == "ray" and (algorithm != "ppo" or options.device != "cpu"):
        fail(f"--engine ray trains ppo on the cpu, not {algorithm} on {options.device}")
    settings = dict(HYPERPARAMETERS[task][algorithm])
    import torch

    torch.set_num_threads(options.threads)
    if options.resume:
        model = load(options.resume / "last.zip", algorithm, settings, options, engine)
        buffer = options.resume / "replay_buffer.pkl"
        if buffer.exists():
            model.load_replay_buffer(buffer)
    elif options.eval_only:
        model = load(options.eval_only / "policy.zip", algorithm, settings, options)
    else:
        model = build(algorithm, settings, options, engine)
    folder = source or options.out or Path("runs") / run_name(task, algorithm, engine, options.seed)
    seconds = 0.0
    if not options.eval_only:
        folder.mkdir(parents=True, exist_ok=True)
        if not options.resume:
            for name in ARTEFACTS:  # of an earlier run in the same folder
                (folder / name).unlink(missing_ok=True)
        seconds, interrupted = train(model, task, algorithm, settings, options, folder, engine)
        print(f"saved the policy, curve.csv and curve.png in {folder}")
        if interrupted:
            print(f"interrupted after {model.num_timesteps} steps; go on with: python train.py --resume {folder}")
            return 130
        model = load(folder / "policy.zip", algorithm, settings, options)
    reports = compare(model, task, algorithm, settings, options.episodes)
    report = {
        "task": task,
        "algo": algorithm,
        "engine": engine,
        "env": settings["env"],
        "seed": options.seed,
        "policy_steps": model.num_timesteps,
        "training_seconds": round(seconds, 1),
        "evaluation_seed": EVALUATION_SEED,
        "versions": versions(engine),
        "held_out": {name: asdict(result) for name, result in reports.items()},
    }
    path = folder / ("evaluation.json" if options.eval_only else "report.json")
    path.write_text(json.dumps(report, indent=2) + "\n")
    print(f"wrote {path}")
    return 0


def run_name(task: str, algorithm: str, engine: str, seed: int) -> str:
    """Return the name of a run's folder."""
    return f"{task}-{algorithm}{'-ray' if engine == 'ray' else ''}-seed{seed}"


def run_seeds(options: argparse.Namespace) -> int:
    """Train with each of the seeds, as many at a time as there are processors for; returns the exit status."""
    task = options.task or "reach"
    parent = (options.out or Path("runs")).absolute()

    def trial(seed: int) -> dict[str, Any]:
        folder = parent / run_name(task, "ppo", "ray", seed)
        run(argparse.Namespace(**{**vars(options), "seed": seed, "out": folder}))
        return json.loads((folder / "report.json").read_text())["held_out"]["ppo"]

    results = ray_engine().run_trials(trial, options.seeds, options.workers, options.address)
    for seed, result in zip(options.seeds, results, strict=True):
        print(f"seed {seed}: {result}")
    return 0


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """Return the command line's options; prints a message and exits with 2 where they make no sense."""
    parser = argparse.ArgumentParser(description="Train and evaluate policies on the TCA arm.")
    parser.add_argument("--task", help=f"one of {', '.join(HYPERPARAMETERS)} (default: reach)")
    parser.add_argument("--algo", help=f"one of {', '.join(ALGORITHMS)} (default: the task's best)")
    parser.add_argument("--steps", type=int, help="environment steps to train, with --resume in addition (default: the task's)")
    parser.add_argument("--seed", type=int, default=0, help="seed of everything random (default: 0)")
    parser.add_argument("--out", type=Path, help="folder of the run (default: runs/TASK-ALGO-seedS)")
    parser.add_argument("--eval-only", type=Path, metavar="PATH", help="evaluate the run in this folder")
    parser.add_argument("--resume", type=Path, metavar="PATH", help="go on with the run in this folder")
    parser.add_argument("--episodes", type=int, default=200, help="held-out episodes to evaluate (default: 200)")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch (default: 1: the networks are small)")
    parser.add_argument("--device", default="cpu", help="torch device (default: cpu)")
    parser.add_argument("--engine", default="sb3", help="sb3 (in one process) or ray (ppo with workers) (default: sb3)")
    parser.add_argument("--workers", type=int, default=1, help="with ray: processes that step environments (default: 1)")
    parser.add_argument("--address", help="with ray: of a running cluster (default: start one on this machine)")
    parser.add_argument("--seeds", type=int, nargs="+", help="with ray: train once with each, side by side")
    options = parser.parse_args(arguments)
    if options.task is not None and options.task not in HYPERPARAMETERS:
        fail(f"--task {options.task}: unknown; the tasks are {', '.join(HYPERPARAMETERS)}")
    if options.algo is not None and options.algo not in ALGORITHMS:
        fail(f"--algo {options.algo}: unknown; the algorithms are {', '.join(ALGORITHMS)}")
    if options.engine not in ENGINES:
        fail(f"--engine {options.engine}: unknown; the engines are {', '.join(ENGINES)}")
    if options.seeds and options.engine != "ray":
        fail("--seeds needs --engine ray")
    for name in ("steps", "episodes", "threads", "workers"):
        value = getattr(options, name)
        if value is not None and value < 1:
            fail(f"--{name} {value}: expected a positive integer")
    for name, seeds in (("seed", [options.seed]), ("seeds", options.seeds or [])):
        if min(seeds, default=0) < 0:
            fail(f"--{name} {' '.join(map(str, seeds))}: expected integers of at least 0")
    if options.eval_only is not None and options.resume is not None:
        fail("--eval-only and --resume exclude each other")
    return options


def fail(message: str) -> NoReturn:
    """Print a message and exit with 2."""
    print(f"train.py: {message}", file=sys.stderr)
    raise SystemExit(2)


def read_description(folder: Path) -> dict[str, Any]:
    """Return what a run's folder says of its policy."""
    path = folder / "policy.json"
    try:
        description = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        fail(f"{folder}: expected the folder of a run, with policy.zip and policy.json ({error})")
    if not isinstance(description, dict):
        fail(f"{path}: expected an object with task and algo")
    if description.get("algo") not in HYPERPARAMETERS.get(str(description.get("task")), {}):
        fail(
            f"{path}: task {description.get('task')!r} with {description.get('algo')!r} is unknown; the tasks are "
            f"{', '.join(HYPERPARAMETERS)}, the algorithms {', '.join(ALGORITHMS)}"
        )
    return description


def learner(algorithm: str, engine: str) -> Any:
    """Return the class of an algorithm: Stable-Baselines3's or our own in its form."""
    import stable_baselines3

    if engine == "ray":
        return ray_engine().RayPPO

    from agents.dagger import DAgger

    return DAgger if algorithm == "dagger" else getattr(stable_baselines3, algorithm.upper())


def ray_engine() -> Any:
    """Return the module that trains with Ray; prints a message and exits with 2 if Ray is missing."""
    try:
        from agents import ray_engine
    except ModuleNotFoundError as error:
        fail(f"--engine ray needs Ray: pip install -e '.[train,ray]' ({error})")
    return ray_engine


def environments(settings: dict[str, Any], seed: int) -> Any:
    """Return the vector of training environments."""
    from stable_baselines3.common.env_util import make_vec_env

    def make() -> gymnasium.Env[Any, Any]:
        env = gymnasium.make(settings["env"])
        if "done_steps" not in settings:
            return env
        from agents.dagger import EndWhenDone

        return EndWhenDone(env, settings["done_steps"])

    return make_vec_env(make, n_envs=settings["envs"], seed=seed)


def build(algorithm: str, settings: dict[str, Any], options: argparse.Namespace, engine: str) -> Any:
    """Return a fresh model."""
    extra = {name: value for name, value in settings.items() if name not in ("env", "steps", "envs", "done_steps")}
    if engine == "ray":
        extra |= {"env_id": settings["env"], "workers": options.workers, "address": options.address}
    return learner(algorithm, engine)(
        "MultiInputPolicy", environments(settings, options.seed), seed=options.seed, device=options.device, **extra
    )


def load(path: Path, algorithm: str, settings: dict[str, Any], options: argparse.Namespace, engine: str = "sb3") -> Any:
    """Return a saved model; prints a message and exits with 2 if it is none or was made for other spaces."""
    try:
        model = learner(algorithm, engine).load(path, device=options.device)
    except Exception as error:  # SB3 passes on whatever torch, pickle and zipfile raise
        fail(f"{path}: expected a {algorithm} policy that this version of stable-baselines3 reads ({error})")
    env = environments(settings, options.seed + model.num_timesteps)  # goals go on, not again
    for name in ("observation_space", "action_space"):
        if getattr(model, name) != getattr(env, name):
            fail(f"{path}: made for the {name} {getattr(model, name)}, but {settings['env']} has {getattr(env, name)}")
    model.set_env(env)
    if engine == "ray":
        model.workers, model.address = options.workers, options.address
    return model


def train(
    model: Any,
    task: str,
    algorithm: str,
    settings: dict[str, Any],
    options: argparse.Namespace,
    folder: Path,
    engine: str,
) -> tuple[float, bool]:
    """Train, save and draw the learning curve; returns the seconds taken and whether Ctrl-C ended it.

    The policy kept is the one that came nearest to the curve's goals; they are of the training split, so that the held-out
    goals stay unseen until the end.
    """
    from stable_baselines3.common.callbacks import BaseCallback

    steps = options.steps or settings["steps"]
    interval = max(CURVE_INTERVAL, steps // CURVE_POINTS)
    env = gymnasium.make(settings["env"])
    curve = read_curve(folder) if options.resume else []
    begun = time.monotonic() - (curve[-1]["seconds"] if curve else 0.0)

    class Curve(BaseCallback):
        """Evaluate now and then, and keep the policy that did best."""

        due = model.num_timesteps + interval

        def _on_step(self) -> bool:
            if self.num_timesteps >= self.due:
                self.due += interval
                self.add_point()
            return True

        def _on_training_end(self) -> None:
            if not curve or curve[-1]["steps"] < self.num_timesteps:
                self.add_point()

        def add_point(self) -> None:
            report = evaluate(self.model, env, CURVE_EPISODES, CURVE_SEED)
            curve.append(
                {
                    "steps": self.num_timesteps,
                    "seconds": round(time.monotonic() - begun, 1),
                    "success_rate": report.success_rate,
                    "final_distance_mm": report.final_distance_mm,
                    "episode_return": report.episode_return,
                }
            )
            save_curve(curve, folder)
            if curve[-1] is min(curve, key=lambda row: row["final_distance_mm"]):
                self.model.save(folder / "policy.zip")

    print(f"training {algorithm} on {settings['env']} for {steps} steps, seed {options.seed}, into {folder}")
    description = {
        "task": task,
        "algo": algorithm,
        "engine": engine,
        "seed": options.seed,
        "env": settings["env"],
        "versions": versions(engine),
    }
    (folder / "policy.json").write_text(json.dumps(description, indent=2) + "\n")
    interrupted = False
    try:
        model.learn(steps, callback=Curve(), reset_num_timesteps=False, progress_bar=True)
    except KeyboardInterrupt:
        interrupted = True
    seconds = time.monotonic() - begun
    model.save(folder / "last.zip")
    if not (folder / "policy.zip").exists():
        model.save(folder / "policy.zip")
    if hasattr(model, "save_replay_buffer"):
        model.save_replay_buffer(folder / "replay_buffer.pkl")
    save_curve(curve, folder)
    return seconds, interrupted


ENGINES = ("sb3", "ray")
CURVE_COLUMNS = ("steps", "seconds", "success_rate", "final_distance_mm", "episode_return")


def read_curve(folder: Path) -> list[dict[str, float]]:
    """Return the learning curve of a run, empty if it has none."""
    path = folder / "curve.csv"
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


def save_curve(curve: list[dict[str, float]], folder: Path) -> None:
    """Write the learning curve as curve.csv and curve.png."""
    with (folder / "curve.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, CURVE_COLUMNS)
        writer.writeheader()
        writer.writerows(curve)
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import LogLocator

    figure, (top, bottom) = plt.subplots(2, 1, sharex=True, figsize=(6.0, 5.0), layout="constrained")
    steps = [row["steps"] / 1000.0 for row in curve]
    top.plot(steps, [100.0 * row["success_rate"] for row in curve], "o-", ms=3)
    top.set(ylabel="success rate [%]", ylim=(-3, 103), title=f"{folder.name}: {CURVE_EPISODES} episodes per point")
    bottom.semilogy(steps, [row["final_distance_mm"] for row in curve], "o-", ms=3, color="tab:orange")
    bottom.set(xlabel="environment steps [thousands]", ylabel="mean final distance [mm]")
    bottom.yaxis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
    for axis_format in (bottom.yaxis.set_major_formatter, bottom.yaxis.set_minor_formatter):
        axis_format("{x:g}")
    for axes in (top, bottom):
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(folder / "curve.png", dpi=150)
    plt.close(figure)


def compare(model: Any, task: str, algorithm: str, settings: dict[str, Any], episodes: int) -> dict[str, Report]:
    """Return the reports of the policy, the scripted controller and a random policy on the same held-out goals."""
    from tqdm import tqdm

    env = gymnasium.make(settings["env"], split="held-out")
    policies: dict[str, Policy] = {
        algorithm: model,
        "scripted": CONTROLLERS[task](),
        "random": RandomPolicy(model.action_space.shape[0]),
    }
    reports = {}
    for name, policy in policies.items():
        with tqdm(total=episodes, desc=f"{name} on held-out goals", leave=False) as bar:
            reports[name] = evaluate(policy, env, episodes, EVALUATION_SEED, lambda _: bar.update())
    for name, report in reports.items():
        print(f"{name:>9}: {report}")
    return reports


def versions(engine: str) -> dict[str, str]:
    """Return the versions that made a policy."""
    names = ("tca_envs", "gymnasium", "stable_baselines3", "torch", "numpy", "numba", *(["ray"] if engine == "ray" else []))
    return {"python": platform.python_version(), **{name: version(name) for name in names}}


if __name__ == "__main__":
    sys.exit(main())
