"""The documentation: tables in docstrings agree with the spaces; the site builds, is complete and loads nothing remote."""

import functools
import inspect
import os
import re
import shutil
import subprocess
import sys
import threading
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote, urlsplit

import gymnasium as gym
import numpy as np
import pytest

import tca_envs  # noqa: F401  (registers the environments)
from tca_envs import registry
from tca_envs.env import ArmEnv
from tca_envs.robots import paper
from tca_envs.tasks.task import Task

ROOT = Path(__file__).parents[1]
SECTIONS = ["Description", "Action Space", "Observation Space", "Rewards", "Starting State", "Episode End", "Arguments"]
SECTIONS.append("Version History")
ENTRIES = [entry for entry in registry.entries() if registry.load(entry.task).__module__.startswith("tca_envs.")]
TASKS = {entry.name: registry.load(entry.task) for entry in ENTRIES}
SPECS = [gym.spec(name) for entry in ENTRIES for name in entry.ids.values()]


def section(task, title):
    return re.split(r"^## (.*)$", inspect.getdoc(TASKS[task]), flags=re.M)[2 * SECTIONS.index(title) + 2]


def rows(text):
    """Cells of a table's rows below its header."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def indices(cell):
    """The numbers that "0..2" or "3, 4" stands for."""
    first, _, last = cell.partition("..")
    return list(range(int(first), int(last) + 1)) if last else [int(number) for number in cell.split(",")]


def bound(cell, count):
    return np.broadcast_to([np.float32(number) for number in cell.split(",")], count)


@pytest.mark.parametrize("task", TASKS)
def test_docstrings_have_the_sections_of_a_page(task):
    assert re.findall(r"^## (.*)$", inspect.getdoc(TASKS[task]), re.M) == SECTIONS


@pytest.mark.parametrize("task", TASKS)
def test_the_table_of_observations_is_the_space(task):
    env, key = gym.make(next(spec.id for spec in SPECS if spec.kwargs["task"] == task)), ""
    seen = {name: [] for name in env.observation_space}
    for name, index, _, low, high, unit in rows(section(task, "Observation Space")):
        key = name.strip("`") or key  # the first row of a key names it
        at = indices(index)
        assert (bound(low, len(at)) == env.observation_space[key].low[at]).all(), (key, index)
        assert (bound(high, len(at)) == env.observation_space[key].high[at]).all(), (key, index)
        assert unit
        seen[key] += at
    assert seen == {key: list(range(box.shape[0])) for key, box in env.observation_space.items()}


@pytest.mark.parametrize("task", TASKS)
def test_the_table_of_actions_is_the_space_and_its_units(task):
    env = gym.make(next(spec.id for spec in SPECS if spec.kwargs["task"] == task))
    text, seen = section(task, "Action Space"), []
    assert f"`Box(-1, 1, {env.action_space.shape}, float32)`" in text
    assert str(env.action_space) == f"Box(-1.0, 1.0, {env.action_space.shape}, float32)"
    full = env.unwrapped.core.heating.max_power
    for index, _, low, high, unit in rows(text):
        at = indices(index)
        if unit == "W":
            assert float(low) == 0.0 and (float(high) == full[at].round(2)).all(), index
        else:
            assert unit == "mm/s" and -float(low) == float(high) == 1e3 * paper.STAGE.speed
        seen += at
    assert seen == list(range(*env.action_space.shape))


@pytest.mark.parametrize("task", TASKS)
def test_arguments_are_those_of_the_environment(task):
    """Those of `ArmEnv` and those that it hands on to the task; defaults that are objects are told in words."""
    parameters = {}
    for owner in (Task, TASKS[task], ArmEnv):
        parameters |= {name: one for name, one in inspect.signature(owner).parameters.items() if one.kind != one.VAR_KEYWORD}
    listed = {name.strip("` "): default for names, default, _ in rows(section(task, "Arguments")) for name in names.split(",")}
    assert set(listed) == set(parameters) - {"task"}
    for name, shown in listed.items():
        value = parameters[name].default
        first = re.match(r'`?("[^"]*"|[^\s`]+)', shown)[1]
        if isinstance(value, int | float):
            assert float(first) == value, name
        elif isinstance(value, str | None):
            assert first == (f'"{value}"' if value else "None"), name


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: spec.id)
def test_the_length_of_episodes_is_said(spec):
    task = spec.kwargs["task"]
    assert f"Truncation after {spec.max_episode_steps} steps of 0.1 s" in section(task, "Episode End")
    assert f"`{spec.id}`" in section(task, "Rewards")


EXAMPLES = re.findall(r"```python\n(.*?)```", (ROOT / "docs/seeing.md").read_text(encoding="utf-8"), re.S)


@pytest.mark.usefixtures("drawing")
def test_examples_of_pictures_run(tmp_path):
    pytest.importorskip("moviepy", reason='MoviePy is missing: pip install -e ".[video]"')
    path = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-W", "error", "-c", "\n".join(EXAMPLES)]
    done = subprocess.run(command, cwd=tmp_path, env=path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    picture, nearest, distance = done.stdout.splitlines()
    assert picture == "(480, 640, 3) uint8"
    assert 0.1 < float(nearest) < 0.2  # the camera stands 200 mm from the arm
    assert float(distance) < 1.0
    assert list((tmp_path / "runs/videos").glob("*.mp4"))


class Page(HTMLParser):
    """What a page of the site contains."""

    def __init__(self, text):
        super().__init__()
        self.ids, self.links, self.loads, self.math, self.prose = set(), [], [], [], ""
        self.inside = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.ids.add(attrs.get("id"))
        if tag == "a" and "href" in attrs:
            self.links.append(attrs["href"])
        if tag == "link" and attrs.get("rel") != "canonical":
            self.loads.append(attrs["href"])
        if "src" in attrs:
            self.loads.append(attrs["src"])
        if tag in ("code", "script", "style", "math"):
            self.inside.append(tag)
        if tag == "math":
            self.math.append("")

    def handle_endtag(self, tag):
        if self.inside and tag == self.inside[-1]:
            self.inside.pop()

    def handle_data(self, data):
        if not self.inside:
            self.prose += data
        elif self.inside[-1] == "math":
            self.math[-1] += data


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    missing = [name for name in ("mkdocs", "material", "mkdocstrings", "latex2mathml", "ziamath") if find_spec(name) is None]
    if missing:
        pytest.skip(f"needs {', '.join(missing)}: pip install -e '.[docs]'")
    target = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(target)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and "WARNING  -" not in done.stderr, done.stderr
    return target


@pytest.fixture(scope="module")
def pages(folder):
    return {path.relative_to(folder).as_posix(): Page(path.read_text(encoding="utf-8")) for path in folder.rglob("*.html")}


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: spec.id)
def test_every_environment_has_a_page(spec, folder):
    text = (folder / "environments" / f"{spec.kwargs['task']}.html").read_text(encoding="utf-8")
    assert f"<td><code>{spec.id}</code></td>" in text
    for title in SECTIONS:
        assert f'<h2 id="{title.lower().replace(" ", "-")}">' in text


def test_the_site_holds_no_sources(folder):
    assert not [path for path in folder.rglob("*") if path.suffix in (".py", ".csv", ".pyc")]


@pytest.mark.parametrize("name", ["model", "solver"])
def test_equations_become_mathml(name, pages):
    page = pages[f"{name}.html"]
    source = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
    assert len(page.math) == len(re.findall(r"\$[^$]+\$|^```math$", source, re.M)) > 0
    assert not [text for text in page.math if "\\" in text or not text.strip()]  # a command that is not known stays as it is


def test_no_latex_is_left_over(pages):
    for name, page in pages.items():
        assert "$" not in page.prose and "\\(" not in page.prose, name


def test_links_lead_somewhere(pages, folder):
    for name, page in pages.items():
        for link in page.links + page.loads:
            parts = urlsplit(link)
            if parts.scheme or name == "404.html":  # which is shown under any address, with links from the root
                continue
            target = (folder / name).parent / unquote(parts.path) if parts.path else folder / name
            target = target / "index.html" if target.is_dir() else target
            assert target.exists(), (name, link)
            if parts.fragment:
                at = target.resolve().relative_to(folder.resolve()).as_posix()
                assert unquote(parts.fragment) in pages[at].ids | {"__skip"}, (name, link)


def test_nothing_is_loaded_from_elsewhere(pages, folder):
    for name, page in pages.items():
        assert not [link for link in page.loads if urlsplit(link).scheme or link.startswith("//")], name
    for path in folder.rglob("*.css"):
        assert not re.search(r"(url\(|@import)\s*[\"']?(https?:)?//", path.read_text(encoding="utf-8")), path


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.fixture
def address(folder):
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    thread.join()
    server.server_close()


def test_a_browser_shows_pages_without_a_complaint(address):
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("needs the browser chromium")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page, faults = browser.new_page(viewport={"width": 1300, "height": 900}), []
        page.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("response", lambda response: faults.append(response.url) if response.status >= 400 else None)
        page.on(
            "request", lambda asked: None if asked.url.startswith((address, "data:", "blob:")) else faults.append(asked.url)
        )
        for name in (
            "index.html",
            "environments/reach.html",
            "study/index.html",
            "study/stability.html",
            "api.html",
            "model.html",
        ):
            page.goto(address + name)
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), name
            assert not faults, (name, faults)
        page.evaluate("document.fonts.ready")
        assert page.evaluate("[...document.fonts].some(font => font.family.includes('STIX') && font.status == 'loaded')")
        page.get_by_placeholder("Search").fill("curvature")
        page.get_by_role("link", name="The gripper").first.wait_for()
        assert not faults, faults
        browser.close()
