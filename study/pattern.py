"""The pattern of every study: measure -> table -> figure -> page.

A study says what it measures, which columns its rows have, what its figures show and what its page says; all else is here.
"""

import gc
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from math import isfinite
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from agents.output import markdown_table, save_figure, write_csv

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = (
    "#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9", "#882255", "#999933", "#332288", "#44AA99", "#661100",
)  # fmt: skip
"""Of Okabe & Ito and of Tol's muted scheme: told apart with every kind of colour vision."""


class Column(NamedTuple):
    """A column of a CSV file, of a table, or of both."""

    value: str | Callable[[Any], Any]  # of a row: the name of an attribute, or a function
    name: str = ""  # in the CSV file; empty: it is not there
    heading: str = ""  # in the table; empty: it is not there
    text: Callable[[Any], str] = str  # value -> cell of the table

    def of(self, row: Any) -> Any:
        """Return the value of a row."""
        return getattr(row, self.value) if isinstance(self.value, str) else self.value(row)


class Study(NamedTuple):
    """A command: what is measured, and what is written of it."""

    name: str  # of the command
    help: str
    measure: Callable[..., Any]  # keyword arguments as `options` says -> what was found
    options: tuple[str, ...] = ("quick",)  # of the command line, beside --out
    tables: Mapping[str, tuple[Sequence[Column], Callable[[Any], Iterable[Any]]]] = {}  # CSV file -> columns, found -> rows
    figures: Callable[[Any], "Iterator[tuple[str, Figure]]"] = lambda found: iter(())  # found -> PNG files
    page: tuple[str, Callable[[Any], str]] | None = None  # Markdown file, found -> its text
    findings: Callable[[Any], str] = lambda found: ""  # found -> what to print
    packages: tuple[str, ...] = ("matplotlib", "tqdm")  # that it needs beside the package's dependencies


def run(study: Study, out: Path, say: Callable[[str], object] = print, **options: Any) -> None:
    """Measure, and write tables, figures and page into the folder `out`, which exists; `say` is told what was found."""
    found = study.measure(**options)
    for name, (columns, rows) in study.tables.items():
        save_table(out / name, columns, rows(found))
    written = list(study.tables)
    for name, figure in study.figures(found):
        save_figure(figure, out / name)
        written.append(name)
    if study.page is not None:
        name, text = study.page
        (out / name).write_text(text(found), encoding="utf-8")
        written.append(name)
    say(study.findings(found))
    say(f"wrote {', '.join(written)} in {out}")


# Measuring


def require(package: str) -> None:
    """Raise ModuleNotFoundError, with what to do, where a package of the extra `train` is missing."""
    if find_spec(package) is None:
        raise ModuleNotFoundError(f"this needs {package}, which is in the extra `train`: pip install 'tca_envs[train]'")


def progress(items: Iterable[Any], what: str = "", unit: str = "it", total: int | None = None) -> Any:
    """Return the items, with a bar that shows how far they are."""
    from tqdm import tqdm

    return tqdm(items, desc=what or None, unit=unit, total=total)


@contextmanager
def no_collection() -> Iterator[None]:
    """Keep Python from collecting garbage meanwhile."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def seconds(call: Callable[[], object]) -> float:
    """Return how long a call takes [s]."""
    begun = time.perf_counter()
    call()
    return time.perf_counter() - begun


def evenly(items: Sequence[Any], count: int) -> list[Any]:
    """Return `count` of the items (all, if there are no more), evenly spaced, the first and the last among them."""
    places = np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)
    return [items[place] for place in places]


# Tables


def numbered(*names: str) -> list[Column]:
    """Return the columns of a CSV file whose rows are tuples."""
    return [Column(itemgetter(k), name) for k, name in enumerate(names)]


def save_table(path: Path, columns: Sequence[Column], rows: Iterable[Any]) -> None:
    """Write those columns that have a name as CSV."""
    columns = [column for column in columns if column.name]
    write_csv(path, [c.name for c in columns], ([c.of(row) for c in columns] for row in rows))


def table(columns: Sequence[Column], rows: Iterable[Any]) -> str:
    """Return those columns that have a heading as a Markdown table."""
    columns = [column for column in columns if column.heading]
    return markdown_table([c.heading for c in columns], [[c.text(c.of(row)) for c in columns] for row in rows])


def names(rows: Iterable[Any], attribute: str) -> list[Any]:
    """Return the different values of an attribute of rows, in order of appearance."""
    return list(dict.fromkeys(getattr(row, attribute) for row in rows))


# Words


def page(*parts: str) -> str:
    """Return the paragraphs that are not empty as Markdown."""
    return "\n\n".join(part.rstrip("\n") for part in parts if part) + "\n"


def bullets(lines: Iterable[str]) -> str:
    """Return a Markdown list."""
    return "\n".join(f"* {line}" for line in lines)


def fixed(form: str, factor: float = 1.0) -> Callable[[float], str]:
    """Return what writes a number times a factor in a format, -- where it is missing."""
    return lambda value: format(factor * value, form) if isfinite(value) else "--"


def percent(share: float) -> str:
    """Return a share in per cent, never rounded to none or all; -- where it is missing."""
    if not isfinite(share):
        return "--"
    return f"{min(max(round(100.0 * share), 1), 99) if 0.0 < share < 1.0 else round(100.0 * share)} %"


def si(value: float, unit: str) -> str:
    """Return a number with three significant digits and a unit with its prefix, -- where it is missing."""
    if not isfinite(value):
        return "--"
    power = 0 if value == 0.0 else int(np.clip(np.floor(np.log10(abs(value)) / 3.0 + 1e-9), -5, 0))
    return f"{value / 1e3**power:.3g} {['', 'm', 'µ', 'n', 'p', 'f'][-power]}{unit}"


def in_seconds(value: float) -> str:
    """Return a time with its unit."""
    return si(value, "s")


def in_metres(value: float) -> str:
    """Return a length with its unit."""
    return si(value, "m")


# Figures


def new_figure(panels: int, width: float, height: float, **options: Any) -> "tuple[Figure, list[Axes]]":
    """Return a figure of width x height [inch] and its panels, side by side, without touching pyplot's state."""
    require("matplotlib")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    axes = list(figure.subplots(1, panels, squeeze=False, **options)[0])
    for panel in axes:
        panel.grid(alpha=0.25, linewidth=0.6)
        panel.spines[["top", "right"]].set_visible(False)
    return figure, axes


def with_units(axes: "Axes", x: str = "", y: str = "") -> None:
    """Label the ticks of axes with units and their prefixes; of an empty one nothing changes."""
    from matplotlib.ticker import EngFormatter

    for axis, unit in ((axes.xaxis, x), (axes.yaxis, y)):
        if unit:
            axis.set_major_formatter(EngFormatter(unit=unit.strip(), sep=" "))


def at_values(axes: "Axes", values: Sequence[float]) -> None:
    """Put ticks at these values of a logarithmic x axis."""
    from matplotlib.ticker import FixedLocator, NullLocator

    axes.xaxis.set_major_locator(FixedLocator(values))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter("{x:.0f}")
