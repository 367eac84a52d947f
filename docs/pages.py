"""Pages that MkDocs makes while it builds the site: overview, environments, equations. Named as a hook in mkdocs.yml."""

import inspect
import re
from html import unescape
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium import spaces
from latex2mathml.converter import convert
from mkdocs.structure.files import File

import tca_envs  # noqa: F401
from tca_envs.tasks import TASKS

ROOT = Path(__file__).parents[1]
OVERVIEW = ("Start", "Use", "Environments", "Cite")
"""Sections of the README that the overview shows after its opening."""
FONT = Path(str(distribution("ziamath").locate_file("ziamath/fonts/STIXTwoMath-Regular.ttf")))
"""Browsers place scripts and brackets well only with a font that is made for mathematics; site.css names it."""
PICTURES = (".webp", ".gif", ".png")
"""A task's picture in docs/ has its name and one of these, the first that is there."""


def on_files(files: Any, config: Any) -> Any:
    """Add the overview, a page for each task and the font of the equations."""
    files.append(File.generated(config, "index.md", content=overview((ROOT / "README.md").read_text(encoding="utf-8"))))
    for name in TASKS:
        picture = next((name + end for end in PICTURES if files.get_file_from_path(name + end)), None)
        files.append(File.generated(config, f"environments/{name}.md", content=environment(name, picture)))
    files.append(File.generated(config, FONT.name, abs_src_path=str(FONT)))
    return files


def on_page_content(html: str, **_: Any) -> str:
    """Turn what `pymdownx.arithmatex` marks as LaTeX into MathML, which needs no script; keep short cells in one line."""
    html = re.sub(r'<span class="arithmatex">\\\((.*?)\\\)</span>', lambda m: convert(unescape(m[1])), html, flags=re.S)
    html = re.sub(
        r'<div class="arithmatex">\\\[(.*?)\\\]</div>',
        lambda m: f'<div class="equation">{convert(unescape(m[1]), display="block")}</div>',
        html,
        flags=re.S,
    )
    return re.sub(r"<td>[^<]{1,20}</td>", lambda m: m[0].replace(" ", "&nbsp;"), html)


def overview(readme: str) -> str:
    """Return the README's opening and some of its sections; its links start in docs/."""
    opening, *sections = re.split(r"^(?=## )", readme, flags=re.M)
    by_title = {section.splitlines()[0].removeprefix("## "): section for section in sections}
    text = "".join([opening, *(by_title[title] for title in OVERVIEW)])
    return re.sub(r'(\]\(|src=")docs/', r"\1", text)


def environment(name: str, picture: str | None) -> str:
    """Return a task's page: its ids and spaces as Gymnasium sees them, and the docstring of its class."""
    task = TASKS[name]
    assert isinstance(task, type)
    specs = [spec for spec in gymnasium.registry.values() if spec.kwargs.get("task") == name]
    env = gymnasium.make(specs[0].id)
    boxes = env.observation_space
    assert isinstance(boxes, spaces.Dict)
    lead, _, rest = (inspect.getdoc(task) or "").partition("\n\n")
    return "\n".join(
        [
            f"# {task.__name__}\n\n{lead}\n",
            f"![{task.__name__}](../{picture})\n" if picture else "",
            "| Id | Reward | Steps of an episode |\n|---|---|---|",
            *(f"| `{spec.id}` | {spec.kwargs['reward']} | {spec.max_episode_steps} |" for spec in specs),
            "\n| Space | |\n|---|---|",
            f"| `action_space` | `{env.action_space}` |",
            *(f'| `observation_space["{key}"]` | `{" ".join(str(box).split())}` |' for key, box in boxes.items()),
            f'\n```python\nimport gymnasium\nimport tca_envs\n\nenv = gymnasium.make("{specs[0].id}")\n```\n',
            rest.replace("degC", "°C"),
        ]
    )
