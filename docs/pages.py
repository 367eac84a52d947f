"""A hook of MkDocs, named in mkdocs.yml: makes the overview and the environments' pages, and converts equations."""

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

import tca_envs  # noqa: F401  (registers the environments)
from tca_envs import registry

ROOT = Path(__file__).parents[1]
FONT = Path(str(distribution("ziamath").locate_file("ziamath/fonts/STIXTwoMath-Regular.ttf")))
"""Browsers place indices and brackets well only with a font for mathematics; site.css names it."""
PICTURES = (".webp", ".gif", ".png")
"""A picture of a task in docs/ has the task's name and the first of these endings that exists."""


def on_files(files: Any, config: Any) -> Any:
    """Add the overview, a page for each task and the font of the equations."""
    files.append(File.generated(config, "index.md", content=overview((ROOT / "README.md").read_text(encoding="utf-8"))))
    for entry in registry.entries():
        if entry.page is not None:
            picture = next((entry.name + end for end in PICTURES if files.get_file_from_path(entry.name + end)), None)
            files.append(File.generated(config, entry.page, content=environment(entry, picture)))
    files.append(File.generated(config, FONT.name, abs_src_path=str(FONT)))
    return files


def on_page_content(html: str, **_: Any) -> str:
    """Turn LaTeX that `pymdownx.arithmatex` marked into MathML, which needs no script; keep short cells on one line."""
    html = re.sub(r'<span class="arithmatex">\\\((.*?)\\\)</span>', lambda m: convert(unescape(m[1])), html, flags=re.S)
    html = re.sub(
        r'<div class="arithmatex">\\\[(.*?)\\\]</div>',
        lambda m: f'<div class="equation">{convert(unescape(m[1]), display="block")}</div>',
        html,
        flags=re.S,
    )
    return re.sub(r"<td>[^<]{1,20}</td>", lambda m: m[0].replace(" ", "&nbsp;"), html)


def overview(readme: str) -> str:
    """Return the README without its license; links start in docs/ instead of the repository's root."""
    text, _, _ = readme.partition("\n## License\n")
    return re.sub(r'(\]\(|src=")docs/', r"\1", text)


def environment(entry: registry.Entry, picture: str | None) -> str:
    """Return the page of a task: ids and spaces as Gymnasium sees them, and the docstring of its class."""
    task = registry.load(entry.task)
    specs = [gymnasium.spec(name) for name in entry.ids.values()]
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
