"""Train a policy on a task, evaluate it on held-out goals beside a scripted controller and a random policy, and save it.

python train.py [--task reach] [--algo sac] [--steps N] [--seed S]      train and evaluate
python train.py --resume runs/reach-sac-seed0                           continue a run
python train.py --eval-only runs/reach-sac-seed0                        evaluate a run
python train.py --eval-only pretrained [--task reach]                   evaluate the trained policy of the repository
python train.py --eval-only pretrained --video out.mp4                  and film it
python train.py --tune 30 [--task reach] [--algo ppo]                   search for better settings
python train.py --engine ray [--workers 2] [--seeds 0 1 2]              train PPO by Ray RLlib on several cores or machines
python train.py --benchmark [--seeds 0 1 2] [--jobs 2]                  all algorithms on all tasks: table and learning curves
"""

import argparse
import os
import sys
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import NoReturn

from agents import training
from agents.hyperparameters import ALGORITHMS, default_algorithm, settings_of
from agents.training import Job, RunError
from tca_envs import registry


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    options = parse(arguments)
    try:
        if options.benchmark:
            return run_benchmark(options)
        if options.resume:
            options.engine = training.read_description(options.resume).get("engine", "sb3")
        if options.engine == "ray":
            return run_with_ray(options)
        return run(options)
    except RunError as error:
        fail(str(error))


def run_benchmark(options: argparse.Namespace) -> int:
    """Train all algorithms on all tasks and compare them; returns the exit status."""
    from agents.benchmark import benchmark

    tasks = [options.task] if options.task else known()
    benchmark(options.out or Path("docs/benchmark"), tasks, options.seeds or [0, 1, 2], options.jobs, options.quick)
    return 0


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
        options.eval_only = training.PRETRAINED / registry.entry(options.task or "reach").name
    source = options.eval_only or options.resume
    job = job_in(source, options) if source else asked(options)
    if options.tune is not None:
        if find_spec("optuna") is None:
            fail("--tune needs Optuna, which is in the extra `tune`: pip install -e '.[train,tune]'")
        from agents.tuning import tune

        tune(
            job,
            options.tune,
            options.steps,
            options.out or Path("runs") / f"tune-{registry.entry(job.task).name}-{job.algorithm}",
        )
        return 0
    folder = source or options.out or Path("runs") / job.name
    if options.eval_only:
        training.set_threads(job.threads)
        policy = training.load(job, folder / "policy.zip")
        training.write_report(job, policy, folder / "evaluation.json", options.episodes)
    else:
        try:
            policy = training.run(job, folder, options.steps, options.episodes, resume=options.resume is not None)
        except training.Interrupted as stop:
            print(f"{stop}; go on with: python train.py --resume {folder}")
            return 130
    if options.video:
        training.film(job, policy, options.video)
    return 0


def run_seeds(options: argparse.Namespace) -> int:
    """Train with each of the seeds, as many at a time as there are processors for; returns the exit status."""
    parent = options.out or Path("runs")
    try:
        reports = training.run_seeds(asked(options), options.seeds, parent, options.steps, options.episodes)
    except KeyboardInterrupt:
        print(f"interrupted; runs that have begun go on with: python train.py --resume {parent.absolute()}/...")
        return 130
    for seed, report in zip(options.seeds, reports, strict=True):
        print(f"seed {seed}: {report}")
    return 0


def asked(options: argparse.Namespace) -> Job:
    """Return the job that the options ask for."""
    task = options.task or "reach"
    algorithm = options.algo or ("ppo" if options.engine == "ray" else default_algorithm(task))
    return job_of(task, algorithm, options.seed, options)


def job_in(folder: Path, options: argparse.Namespace) -> Job:
    """Return the job of a run's folder."""
    found = training.read_description(folder)
    if options.task is not None and registry.entry(options.task) != registry.entry(found["task"]):
        fail(f"{folder} holds a policy for the task {found['task']!r}, not {options.task!r}")
    if options.algo is not None and options.algo != found["algo"]:
        fail(f"{folder} holds a policy of {found['algo']!r}, not {options.algo!r}")
    return job_of(found["task"], found["algo"], found.get("seed", options.seed), options)


def job_of(task: str, algorithm: str, seed: int, options: argparse.Namespace) -> Job:
    """Return a job on the machine that the options name."""
    settings = settings_of(task)
    if algorithm not in settings:
        fail(f"--algo {algorithm}: {task} has no settings of it; it has those of {', '.join(settings)}")
    return Job(task, algorithm, settings[algorithm], seed, options.engine, options.device, options.threads, options.workers)


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """Return the command line's options; prints a message and exits with 2 where they make no sense."""
    options = parser().parse_args(arguments)
    check_names(options)
    check_numbers(options)
    if options.video:
        check_video(options.video)
    chosen = [name for name in ("eval_only", "resume", "tune", "benchmark") if getattr(options, name)]
    if options.video and (options.tune or options.benchmark or options.seeds):
        fail("--video is for one policy, not with --tune, --benchmark or --seeds")
    if len(chosen) > 1:
        fail(f"{' and '.join('--' + name.replace('_', '-') for name in chosen)} exclude each other")
    return options


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(description="Train and evaluate policies on the TCA arm.")
    add = made.add_argument
    add("--task", help=f"one of {', '.join(known())}, or module:name of one that a module registers (default: reach)")
    add("--algo", help=f"one of {', '.join(ALGORITHMS)} (default: the task's best)")
    steps = "with --resume in addition (default: the missing steps of a run that was cut short, else the task's)"
    add("--steps", type=int, help=f"environment steps to train, {steps}")
    add("--seed", type=int, default=0, help="seed of everything random (default: 0)")
    add("--out", type=Path, help="folder of the run (default: runs/TASK-ALGO-seedS; of a benchmark docs/benchmark)")
    pretrained = '"pretrained" is the repository\'s policy for the task'
    add("--eval-only", type=Path, metavar="PATH", help=f"evaluate the run in this folder; {pretrained}")
    add("--resume", type=Path, metavar="PATH", help="continue the run in this folder")
    add("--tune", type=int, metavar="N", help="search for better settings in N trials, with --steps each")
    add("--benchmark", action="store_true", help="train all algorithms on all tasks, or on --task, and compare them")
    add("--seeds", type=int, nargs="+", help="of the benchmark (default: 0 1 2), or of several runs with ray")
    add("--jobs", type=int, default=1, help="runs of the benchmark at a time (default: 1)")
    add("--quick", action="store_true", help="a hundredth of the benchmark, to see whether it works")
    add("--episodes", type=int, default=200, help="held-out episodes to evaluate (default: 200)")
    filmed = f"film {training.FILMED_EPISODES} held-out episodes of the policy: .mp4, .webp or .gif"
    add("--video", type=Path, metavar="FILE", help=filmed)
    add("--threads", type=int, default=1, help="threads of torch (default: 1: the networks are small)")
    add("--device", default="cpu", help="torch device (default: cpu)")
    add("--engine", default="sb3", help="sb3 (in one process) or ray (ppo with workers) (default: sb3)")
    add("--workers", type=int, default=1, help="with ray: processes that step environments (default: 1)")
    add("--address", help="with ray: of a running cluster (default: start one on this machine)")
    return made


def known() -> list[str]:
    """Return the names of the tasks that are registered."""
    return [entry.name for entry in registry.entries()]


def check_names(options: argparse.Namespace) -> None:
    """Fail for an unknown task, algorithm or engine, or one that the engine cannot train."""
    if options.task is not None:
        try:
            registry.entry(options.task)
        except ImportError as error:
            fail(f"--task {options.task}: {error}")
        except ValueError:
            fail(f"--task {options.task}: unknown; the tasks are {', '.join(known())}, or module:name")
    if options.algo is not None and options.algo not in ALGORITHMS:
        fail(f"--algo {options.algo}: unknown; the algorithms are {', '.join(ALGORITHMS)}")
    if options.engine not in training.ENGINES:
        fail(f"--engine {options.engine}: unknown; the engines are {', '.join(training.ENGINES)}")
    if options.engine == "ray" and (options.algo not in (None, "ppo") or options.device != "cpu"):
        fail(f"--engine ray trains ppo on the cpu, not {options.algo or 'ppo'} on {options.device}")
    if options.seeds and options.engine != "ray" and not options.benchmark:
        fail("--seeds needs --benchmark or --engine ray")


def check_numbers(options: argparse.Namespace) -> None:
    """Fail for numbers out of their ranges."""
    for name in ("steps", "episodes", "threads", "jobs", "tune", "workers"):
        value = getattr(options, name)
        if value is not None and value < 1:
            fail(f"--{name} {value}: expected a positive integer")
    for name, value in (("seed", options.seed), *(("seeds", value) for value in options.seeds or [])):
        if value < 0:
            fail(f"--{name} {value}: expected an integer of at least 0")


def check_video(path: Path) -> None:
    """Fail where no film can be written."""
    from agents.video import check_path

    try:
        check_path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        import pyvista  # noqa: F401
    except (ValueError, OSError) as error:
        fail(f"--video {path}: {error}")
    except ModuleNotFoundError as error:
        fail(f"--video needs PyVista, and MoviePy for .mp4: pip install -e '.[train,video]' ({error})")


def fail(message: str) -> NoReturn:
    """Print a message and exit with 2."""
    print(f"train.py: {message}", file=sys.stderr)
    raise SystemExit(2)


if __name__ == "__main__":
    sys.exit(main())
