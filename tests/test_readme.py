"""What the README shows works."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from agents.scripted import CONTROLLERS

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", README, re.S)


def test_there_are_examples():
    assert len(EXAMPLES) == 3


@pytest.mark.parametrize("example", EXAMPLES)
def test_examples_run(example):
    done = subprocess.run([sys.executable, "-W", "error", "-c", example], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout
    if "ReachController" in example:
        assert done.stdout.startswith("True")
    if "policy.zip" in example:
        assert done.stdout.startswith("success 100.0 %")


def test_files_that_it_names_exist():
    for name in re.findall(r"\]\(([\w/.]+)\)", README) + re.findall(r"(?:python|pytest) ([\w/]+\.py)", README):
        assert (ROOT / name).exists(), name


def test_commands_that_install_name_extras_that_exist():
    project = (ROOT / "pyproject.toml").read_text()
    for extras in re.findall(r'pip install -e "\.\[([\w,]+)\]"', README):
        for extra in extras.split(","):
            assert re.search(rf"^{extra} = \[", project, re.M)


def test_every_registered_environment_is_listed():
    import gymnasium as gym

    import tca_envs  # noqa: F401

    for name, spec in gym.registry.items():
        if "tca_envs" in str(spec.entry_point):
            assert f"`{name}`" in README


def test_mechanics_knows_no_gymnasium():
    for path in (ROOT / "tca_envs" / "mechanics").glob("*.py"):
        assert "gymnasium" not in path.read_text(), path


def test_every_task_has_a_report():
    assert {path.parent.name for path in ROOT.glob("agents/pretrained/*/report.json")} == set(CONTROLLERS)


@pytest.mark.parametrize("report", sorted(ROOT.glob("agents/pretrained/*/report.json")), ids=lambda path: path.parent.name)
def test_results_are_those_of_the_reports(report):
    described = json.loads(report.read_text())
    labels = {"random": "random", "scripted": f"scripted `{CONTROLLERS[described['task']].__name__}`"}
    for name, result in described["held_out"].items():
        low, high = (f"{100.0 * bound:.1f}" for bound in result["success_interval"])
        time = result["time_to_success_s"]
        row = (
            f"| {labels.get(name, name if name == 'dagger' else name.upper()).replace('dagger', 'DAgger')} "
            f"| {100.0 * result['success_rate']:.1f} % ({low}-{high} %) | {result['final_distance_mm']:.2f} mm "
            f"| {'--' if time is None else f'{time:.2f} s'} | {result['energy_J']:.1f} J |"
        )
        assert row in README, row
