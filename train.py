"""Train a policy on a task, evaluate it on held-out goals beside a scripted controller and a random policy, and save it.

python train.py [--task reach] [--algo sac] [--steps N] [--seed S]      train and evaluate
python train.py --resume runs/reach-sac-seed0                           go on with a run
python train.py --eval-only runs/reach-sac-seed0                        evaluate a run
python train.py --eval-only pretrained [--task reach]                   evaluate the policy that comes along
python train.py --eval-only pretrained --video out.mp4                  and film it
python train.py --tune 30 [--task reach] [--algo ppo]                   search for better settings
python train.py --engine ray [--workers 2] [--seeds 0 1 2]              train PPO by Ray RLlib on several cores or machines
python train.py --benchmark [--seeds 0 1 2] [--jobs 2]                  all algorithms on all tasks: table and learning curves
"""

import argparse
import json
import os
import platform
import sys
from contextlib import ExitStack, closing
from dataclasses import asdict
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

import gymnasium

import tca_envs  # noqa: F401  (registers the environments)
from agents.evaluate import Policy, Report, evaluate, lanes_for
from agents.hyperparameters import ALGORITHMS, DEFAULT_ALGORITHM, HYPERPARAMETERS, for_learner
from agents.scripted import CONTROLLERS, RandomPolicy

EVALUATION_SEED = 1_000_000
"""Held-out goals are drawn with seeds from here on."""
PRETRAINED = Path(__file__).parent / "agents" / "pretrained"
ENGINES = ("sb3", "ray")
ARTEFACTS = (
    "policy.zip", "policy.json", "last.zip", "replay_buffer.pkl", "curve.csv", "curve.png", "report.json", "evaluation.json",
    "events.out.tfevents.*",
)  # fmt: skip
"""What a run leaves in its folder, as patterns."""
FILMED_EPISODES = 3
CURVE_SEED = 2_000_000
"""Goals of the learning curve, of the training split, are drawn with seeds from here on."""
CURVE_EPISODES = 30
CURVE_POINTS = 12
CURVE_INTERVAL = 2_000
"""Points of the learning curve lie at least this many steps apart: one costs 3,000 steps of evaluation."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    options = parse(arguments)
    if options.benchmark:
        from agents.benchmark import benchmark

        tasks = [options.task] if options.task else list(HYPERPARAMETERS)
        benchmark(options.out or Path("docs/benchmark"), tasks, options.seeds or [0, 1, 2], options.jobs, options.quick)
        return 0
    if options.resume:
        options.engine = read_description(options.resume).get("engine", "sb3")
    if options.engine == "ray":
        return run_with_ray(options)
    return run(options)


def run_with_ray(options: argparse.Namespace) -> int:
    """Train as asked, once or with each of the seeds, on a Ray cluster; returns the exit status."""
    try:
        from agents.ray_engine import cluster
    except ModuleNotFoundError as error:
        fail(f"--engine ray needs Ray: pip install -e '.[train,ray]' ({error})")
    here = os.cpu_count() or 1
    needed = options.workers + 1 if options.seeds or options.tune else options.workers
    with ExitStack() as stack:
        try:
            stack.enter_context(cluster(options.address, needed if options.address else max(needed, here)))
        except (ConnectionError, ValueError) as error:
            fail(f"--engine ray: {error}")
        return run_seeds(options) if options.seeds else run(options)


def run(options: argparse.Namespace) -> int:
    """Train or evaluate as asked; returns the exit status."""
    if options.eval_only == Path("pretrained"):
        options.eval_only = PRETRAINED / (options.task or "reach")
    source = options.eval_only or options.resume
    task, algorithm = options.task, options.algo
    if source is not None:
        description = read_description(source)
        task = description["task"]
        if options.task is not None and options.task != task:
            fail(f"{source} holds a policy for the task {task!r}, not {options.task!r}")
        if algorithm is not None and algorithm != description["algo"]:
            fail(f"{source} holds a policy of {description['algo']!r}, not {algorithm!r}")
        algorithm = description["algo"]
        options.seed = description.get("seed", options.seed)
    task = task or "reach"
    algorithm = algorithm or ("ppo" if options.engine == "ray" else DEFAULT_ALGORITHM[task])
    settings = dict(HYPERPARAMETERS[task][algorithm])
    import torch

    torch.set_num_threads(options.threads)
    if options.tune is not None:
        if find_spec("optuna") is None:
            fail("--tune needs Optuna, which is in the extra `tune`: pip install -e '.[train,tune]'")
        from agents.tuning import tune

        tune(task, algorithm, settings, options.tune, options, options.out or Path("runs") / f"tune-{task}-{algorithm}")
        return 0
    if options.resume:
        model = load(options.resume / "last.zip", algorithm, settings, options)
        buffer = options.resume / "replay_buffer.pkl"
        if buffer.exists():
            model.load_replay_buffer(buffer)
    elif options.eval_only:
        model = load(options.eval_only / "policy.zip", algorithm, settings, options)
    else:
        model = build(algorithm, settings, options)
    folder = source or options.out or Path("runs") / run_name(task, algorithm, options.engine, options.seed)
    seconds = 0.0
    if not options.eval_only:
        folder.mkdir(parents=True, exist_ok=True)
        if not options.resume:
            clear(folder)
        seconds, interrupted = train(model, task, algorithm, settings, options, folder)
        print(f"saved the policy, curve.csv and curve.png in {folder}")
        if interrupted:
            print(f"interrupted after {model.num_timesteps} steps; go on with: python train.py --resume {folder}")
            return 130
        model = load(folder / "policy.zip", algorithm, settings, options)
    reports = compare(model, task, algorithm, settings, options.episodes)
    report = {
        **describe(model, task, algorithm, settings, options, seconds),
        "evaluation_seed": EVALUATION_SEED,
        "held_out": {name: asdict(result) for name, result in reports.items()},
    }
    path = folder / ("evaluation.json" if options.eval_only else "report.json")
    path.write_text(json.dumps(report, indent=2) + "\n")
    print(f"wrote {path}")
    if options.video:
        film(model, settings, options.video)
    return 0


def film(policy: Policy, settings: dict[str, Any], path: Path) -> None:
    """Write a video of the first held-out episodes."""
    from agents.video import frames, save

    with closing(gymnasium.make(settings["env"], split="held-out", render_mode="rgb_array")) as env:
        save(frames(policy, env, FILMED_EPISODES, EVALUATION_SEED), path, env.metadata["render_fps"])
    print(f"wrote {path}")


def run_name(task: str, algorithm: str, engine: str, seed: int) -> str:
    """Return the name of a run's folder."""
    return f"{task}-{algorithm}{'-ray' if engine == 'ray' else ''}-seed{seed}"


def run_seeds(options: argparse.Namespace) -> int:
    """Train with each of the seeds, as many at a time as there are processors for; returns the exit status."""
    from agents.ray_engine import run_trials

    task = options.task or "reach"
    parent = (options.out or Path("runs")).absolute()

    def trial(seed: int) -> dict[str, Any]:
        folder = parent / run_name(task, "ppo", "ray", seed)
        run(argparse.Namespace(**{**vars(options), "seed": seed, "out": folder}))
        report: dict[str, Any] = json.loads((folder / "report.json").read_text())
        return report["held_out"]["ppo"]

    try:
        results = run_trials(trial, options.seeds, options.workers)
    except KeyboardInterrupt:
        print(f"interrupted; runs that have begun go on with: python train.py --resume {parent}/...")
        return 130
    for seed, result in zip(options.seeds, results, strict=True):
        print(f"seed {seed}: {Report(**result)}")
    return 0


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """Return the command line's options; prints a message and exits with 2 where they make no sense."""
    parser = argparse.ArgumentParser(description="Train and evaluate policies on the TCA arm.")
    parser.add_argument("--task", help=f"one of {', '.join(HYPERPARAMETERS)} (default: reach)")
    parser.add_argument("--algo", help=f"one of {', '.join(ALGORITHMS)} (default: the task's best)")
    parser.add_argument(
        "--steps",
        type=int,
        help="environment steps to train, with --resume in addition (default: what is missing to a run that was cut short, "
        "else the task's)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of everything random (default: 0)")
    parser.add_argument(
        "--out", type=Path, help="folder of the run (default: runs/TASK-ALGO-seedS; of a benchmark docs/benchmark)"
    )
    parser.add_argument(
        "--eval-only",
        type=Path,
        metavar="PATH",
        help='evaluate the run in this folder; "pretrained" is what comes along for the task',
    )
    parser.add_argument("--resume", type=Path, metavar="PATH", help="go on with the run in this folder")
    parser.add_argument("--tune", type=int, metavar="N", help="search for better settings in N trials, with --steps each")
    parser.add_argument(
        "--benchmark",
        action="store_true",
        help="train all algorithms on all tasks, or on --task, and compare them",
    )
    parser.add_argument("--seeds", type=int, nargs="+", help="of the benchmark (default: 0 1 2), or of several runs with ray")
    parser.add_argument("--jobs", type=int, default=1, help="runs of the benchmark at a time (default: 1)")
    parser.add_argument("--quick", action="store_true", help="a hundredth of the benchmark, to see whether it works")
    parser.add_argument("--episodes", type=int, default=200, help="held-out episodes to evaluate (default: 200)")
    parser.add_argument(
        "--video",
        type=Path,
        metavar="FILE",
        help=f"film {FILMED_EPISODES} held-out episodes of the policy: .mp4, .webp or .gif",
    )
    parser.add_argument("--threads", type=int, default=1, help="threads of torch (default: 1: the networks are small)")
    parser.add_argument("--device", default="cpu", help="torch device (default: cpu)")
    parser.add_argument("--engine", default="sb3", help="sb3 (in one process) or ray (ppo with workers) (default: sb3)")
    parser.add_argument("--workers", type=int, default=1, help="with ray: processes that step environments (default: 1)")
    parser.add_argument("--address", help="with ray: of a running cluster (default: start one on this machine)")
    options = parser.parse_args(arguments)
    if options.task is not None and options.task not in HYPERPARAMETERS:
        fail(f"--task {options.task}: unknown; the tasks are {', '.join(HYPERPARAMETERS)}")
    if options.algo is not None and options.algo not in ALGORITHMS:
        fail(f"--algo {options.algo}: unknown; the algorithms are {', '.join(ALGORITHMS)}")
    if options.engine not in ENGINES:
        fail(f"--engine {options.engine}: unknown; the engines are {', '.join(ENGINES)}")
    if options.engine == "ray" and (options.algo not in (None, "ppo") or options.device != "cpu"):
        fail(f"--engine ray trains ppo on the cpu, not {options.algo or 'ppo'} on {options.device}")
    if options.seeds and options.engine != "ray" and not options.benchmark:
        fail("--seeds needs --benchmark or --engine ray")
    for name in ("steps", "episodes", "threads", "jobs", "tune", "workers"):
        value = getattr(options, name)
        if value is not None and value < 1:
            fail(f"--{name} {value}: expected a positive integer")
    for name, value in (("seed", options.seed), *(("seeds", value) for value in options.seeds or [])):
        if value < 0:
            fail(f"--{name} {value}: expected an integer of at least 0")
    if options.video:
        from agents.video import check_path

        try:
            check_path(options.video)
            options.video.parent.mkdir(parents=True, exist_ok=True)
            import pyvista  # noqa: F401
        except (ValueError, OSError) as error:
            fail(f"--video {options.video}: {error}")
        except ModuleNotFoundError as error:
            fail(f"--video needs PyVista, and MoviePy for .mp4: pip install -e '.[train,video]' ({error})")
    chosen = [name for name in ("eval_only", "resume", "tune", "benchmark") if getattr(options, name)]
    if options.video and (options.tune or options.benchmark or options.seeds):
        fail("--video is for one policy, not with --tune, --benchmark or --seeds")
    if len(chosen) > 1:
        fail(f"{' and '.join('--' + name.replace('_', '-') for name in chosen)} exclude each other")
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
    """Return the class of an algorithm for an engine."""
    if engine == "ray":
        from agents.ray_engine import RayPPO

        return RayPPO
    from agents import policies

    return policies.learner(algorithm)


def environments(settings: dict[str, Any], seed: int) -> Any:
    """Return the batch of training environments."""
    from stable_baselines3.common.vec_env import VecMonitor

    from agents.sb3 import make

    return VecMonitor(make(settings["env"], settings["n_envs"], seed, settings.get("done_steps")))


def clear(folder: Path) -> None:
    """Remove what an earlier run left in the same folder."""
    for path in [path for pattern in ARTEFACTS for path in folder.glob(pattern)]:
        path.unlink()


def build(algorithm: str, settings: dict[str, Any], options: argparse.Namespace) -> Any:
    """Return a fresh model."""
    made = for_learner(settings)
    if options.engine == "ray":
        made |= {"env_id": settings["env"], "workers": options.workers}
    return learner(algorithm, options.engine)(
        env=environments(settings, options.seed), seed=options.seed, device=options.device, **made
    )


def load(path: Path, algorithm: str, settings: dict[str, Any], options: argparse.Namespace) -> Any:
    """Return a saved model; prints a message and exits with 2 if it is none or was made for other spaces."""
    if not path.exists():
        fail(f"{path}: not there; a run that ended before its first checkpoint has to start again")
    # Hindsight asks an environment for rewards and is not read without one.
    hindsight = {"env": environments(settings, options.seed)} if "replay_buffer_class" in settings else {}
    try:
        model = learner(algorithm, options.engine).load(path, device=options.device, **hindsight)
    except Exception as error:  # SB3 passes on whatever torch, pickle and zipfile raise
        fail(f"{path}: expected a {algorithm} policy that this version of stable-baselines3 reads ({error})")
    # As many as it was trained with; goals go on, not again.
    env = environments({**settings, "n_envs": model.n_envs}, options.seed + model.num_timesteps)
    for name in ("observation_space", "action_space"):
        if getattr(model, name) != getattr(env, name):
            fail(f"{path}: made for the {name} {getattr(model, name)}, but {settings['env']} has {getattr(env, name)}")
    model.set_env(env)
    if options.engine == "ray":
        model.workers = options.workers
    return model


def train(
    model: Any,
    task: str,
    algorithm: str,
    settings: dict[str, Any],
    options: argparse.Namespace,
    folder: Path,
    progress_bar: bool = True,
) -> tuple[float, bool]:
    """Train, save and draw the learning curve; returns the seconds taken and whether Ctrl-C ended it.

    The policy kept is the one that came nearest to the curve's goals; they are of the training split, so that the held-out
    goals stay unseen until the end.
    """
    from stable_baselines3.common.logger import configure

    from agents.curve import Curve

    left = read_description(folder).get("steps", 0) - model.num_timesteps if options.resume else 0
    steps = options.steps or (left if left > 0 else settings["n_timesteps"])
    print(f"training {algorithm} on {settings['env']} for {steps} steps, seed {options.seed}, into {folder}")
    description = {
        "task": task,
        "algo": algorithm,
        "engine": options.engine,
        "seed": options.seed,
        "env": settings["env"],
        "steps": model.num_timesteps + steps,
        "versions": versions(options.engine),
    }
    (folder / "policy.json").write_text(json.dumps(description, indent=2) + "\n")
    model.set_logger(configure(str(folder), ["tensorboard"] if find_spec("tensorboard") else []))
    curve = Curve(
        folder,
        gymnasium.make_vec(settings["env"], CURVE_EPISODES),
        CURVE_EPISODES,
        CURVE_SEED,
        max(CURVE_INTERVAL, steps // CURVE_POINTS),
        resume=options.resume is not None,
    )
    interrupted = False
    try:
        model.learn(steps, callback=curve, reset_num_timesteps=False, progress_bar=progress_bar)
    except KeyboardInterrupt:
        interrupted = True
        curve.save()
    return curve.seconds, interrupted


def compare(model: Any, task: str, algorithm: str, settings: dict[str, Any], episodes: int) -> dict[str, Report]:
    """Return the reports of the policy, the scripted controller and a random policy on the same held-out goals."""
    from tqdm import tqdm

    env = gymnasium.make_vec(settings["env"], lanes_for(episodes), split="held-out")
    policies: dict[str, Policy] = {
        algorithm: model,
        "scripted": CONTROLLERS[task](),
        "random": RandomPolicy(model.action_space.shape[0]),
    }
    reports = {}
    for name, policy in policies.items():
        with tqdm(total=episodes, desc=f"{name} on held-out goals", leave=False) as bar:
            reports[name] = evaluate(policy, env, episodes, EVALUATION_SEED, lambda done: bar.update(done - bar.n))
    for name, report in reports.items():
        print(f"{name:>9}: {report}")
    return reports


def describe(
    model: Any, task: str, algorithm: str, settings: dict[str, Any], options: argparse.Namespace, seconds: float
) -> dict[str, Any]:
    """Return what a report says of a policy and its training."""
    return {
        "task": task,
        "algo": algorithm,
        "env": settings["env"],
        "seed": options.seed,
        "policy_steps": model.num_timesteps,
        "training_seconds": round(seconds, 1),
        "versions": versions(options.engine),
    }


def versions(engine: str) -> dict[str, str]:
    """Return the versions that made a policy."""
    names = ["tca_envs", "gymnasium", "stable_baselines3", "torch", "numpy", "numba"]
    if engine == "ray":
        names.append("ray")
    return {"python": platform.python_version(), **{name: version(name) for name in names}}


if __name__ == "__main__":
    sys.exit(main())
