"""The page of one visitor: panels, plots and the arm in 3-D, kept up to date by a thread of its own."""

import queue
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

try:
    import viser
    from viser import uplot
except ModuleNotFoundError as error:
    raise ImportError('the viewer needs viser: pip install "tca_envs[viewer]"') from error

from tca_envs import registry
from tca_envs.geometry import HEAT, Part, heat_colour
from tca_envs.mechanics import Rung
from tca_envs.mechanics.thermal import AMBIENT, HARD_LIMIT
from tca_envs.robots.paper import TABLE
from tca_envs.viewer.session import (
    CONTROLLERS,
    MANUAL,
    MOST_GRAVITY,
    MOST_PAYLOAD,
    MOST_TILT,
    Session,
    World,
    controllers,
)  # fmt: skip

Array = NDArray[np.float64]

SCALE = 100.0
"""A scene over the paper's table is drawn in cm: in metres the arm is smaller than what a browser's shadows and near plane are
made for. Others are scaled to it."""
CAMERA, LOOK_AT, VIEW_RAD = (-9.0, 19.0, 1.0), (0.2, 0.0, 4.3), 0.52
"""Where the camera starts and what it looks at [cm], and its vertical field of view [rad]: the arm from top to table."""
TOLERANCES = {"1 mm": 1e-3, "0.1 mm": 1e-4, "10 µm": 1e-5, "1 µm": 1e-6, "10 nm": 1e-8}
FIRST_TOLERANCE = "10 µm"
MOST_SEED = 2**31 - 1
LINES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#6b6b6b")
"""Colours of the TCAs in the plots, which colour-blind readers can tell apart (Okabe and Ito, and a grey)."""
SLOWLY = 2
"""So many steps pass between two drawings of plots and readings."""
PANEL = 350
"""Width of either panel [pixels]."""
PLOT = 178
"""Height of a plot [pixels]: both fit under the readings on a small screen."""
SHORTEST_S = 10.0
"""A plot spans at least this [s], and at most the session's history."""
HOT, TIGHT = (0.0, HARD_LIMIT + 5.0), (-50.0, 300.0)
"""What the plots span [degC], [mN]."""
FONT, TICKS = "11px sans-serif", uplot.Axis_Ticks(size=4.0)
RUNGS = {
    Rung.WARM: "Newton from the last step",
    Rung.SUBSTEPS: "Newton in substeps",
    Rung.FINER: "Newton on a finer grid",
    Rung.DESCENT: "fall down the energy",
    Rung.FAILED: "none found: stays as it was",
}


class Page:
    """What a visitor sees and moves. All of it happens in `run`; what the browser reports is only put down for it.

    Parameters
    ----------
    client : viser.ClientHandle
        The visitor's browser.
    task : str
        What it begins with.
    """

    def __init__(self, client: viser.ClientHandle, task: str) -> None:
        self.client = client
        self.session = Session(task, TOLERANCES[FIRST_TOLERANCE])
        self._titles = {entry.title: entry.name for entry in registry.entries()}
        self.running = True
        self._asked: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._left = threading.Event()
        self._meshes: dict[str, tuple[viser.MeshHandle, Part]] = {}
        self._plots: dict[str, list[viser.GuiUplotHandle]] = {}
        self._sliders: dict[str, list[viser.GuiSliderHandle[float]]] = {}
        self._build()

    def leave(self) -> None:
        """End `run`: the visitor has gone."""
        self._left.set()
        self._asked.put(lambda: None)

    def run(self) -> None:
        """Keep the page up to date until the visitor leaves."""
        due = time.monotonic()
        while not self._left.is_set():
            try:
                self._asked.get(timeout=max(due - time.monotonic(), 0.0) if self.running else None)()
            except queue.Empty:
                self._step()
                # After a slow solve time goes on from there: nothing is caught up.
                due = max(due + self.session.core.step_s, time.monotonic())

    def _build(self) -> None:
        gui = self.client.gui
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False, brand_color=(0, 84, 147))
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL)
        with gui.add_folder("Task"):
            self._tasks = gui.add_button_group("Task", tuple(self._titles))
            self._tolerance = gui.add_dropdown(
                "Tip error",
                tuple(TOLERANCES),
                initial_value=FIRST_TOLERANCE,
                hint="At most; the cheapest grid is taken.",
            )
            self._seed = gui.add_number("Seed", 0, min=0, max=MOST_SEED, step=1, hint="Of the episode: its goal, its object.")
            self._reset = gui.add_button("Reset", icon=viser.Icon.REFRESH)
        with gui.add_folder("Time"):
            self._pause = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
            self._single = gui.add_button(
                f"Step by {self.session.core.step_s:g} s", icon=viser.Icon.PLAYER_TRACK_NEXT, disabled=True
            )
        with gui.add_folder("Drive") as self._drive:
            there = {name for entry in registry.entries() for name in controllers(entry.name)}
            self._controllers = gui.add_button_group("Driven by", tuple(name for name in CONTROLLERS if name in there))
            for name, kind in CONTROLLERS.items():
                if name not in there:
                    gui.add_markdown(f"*{name}: {kind.missing(self.session.task)}*")
        with gui.add_folder("World"):
            self._gravity = gui.add_slider("Gravity [g]", -MOST_GRAVITY, MOST_GRAVITY, 0.05, 1.0, hint="Negative is upwards.")
            self._tilt = gui.add_slider("Tilt [°]", -MOST_TILT, MOST_TILT, 5.0, 0.0, hint="Of gravity, against the vertical.")
            self._payload = gui.add_slider("Payload [g]", 0.0, MOST_PAYLOAD, 0.1, 0.0, hint="Beside what the task hangs there.")
        panel = gui.add_panel()
        with panel.add_tab("Readings") as self._readings:
            self._numbers = gui.add_html("")
        panel.dock_left()
        panel.set_width(PANEL)

        def when(event: Callable[[Callable[[Any], None]], Any], asked: Callable[[], None]) -> None:
            event(lambda _: self._asked.put(asked))

        when(self._tasks.on_click, lambda: self._begin(self._titles[self._tasks.value]))
        when(self._tolerance.on_update, lambda: self._begin(self.session.task))
        when(self._reset.on_click, self._reset_episode)
        when(self._pause.on_click, self._pause_or_run)
        when(self._single.on_click, self._step)
        when(self._controllers.on_click, lambda: self._change_controller(self._controllers.value))
        self._show_controls()

    def _begin(self, task: str) -> None:
        """Start over with a task and the tolerance that is chosen."""
        controller = self.session.controller
        self.session = Session(task, TOLERANCES[self._tolerance.value], self._chosen_seed())
        self._show_controls()
        self._change_controller(controller)

    def _reset_episode(self) -> None:
        self.session.reset(self._chosen_seed())
        self._show_controls()

    def _chosen_seed(self) -> int:
        return int(within(self._seed))

    def _pause_or_run(self) -> None:
        self.running = not self.running
        self._pause.label = "Pause" if self.running else "Run"
        self._pause.icon = viser.Icon.PLAYER_PAUSE if self.running else viser.Icon.PLAYER_PLAY
        self._single.disabled = self.running

    def _change_controller(self, controller: str) -> None:
        self.session.drive_by(controller if controller in controllers(self.session.task) else MANUAL)
        self._name()
        for slider in self._sliders.get(self.session.task, []):
            slider.disabled = self.session.controller != MANUAL

    def _step(self) -> None:
        session = self.session
        session.world = World(within(self._gravity), within(self._tilt), within(self._payload))
        if session.controller == MANUAL:
            session.command[:] = [slider.value for slider in self._sliders[session.task]]
        session.step()
        with self.client.atomic():
            self._draw()
            if session.core.record.steps[0] % SLOWLY == 0 or not self.running:
                self._tell()

    def _show_controls(self) -> None:
        """Show what belongs to the session's task, and where it is."""
        # Nothing is removed: a browser that is behind would complain of what came last for it.
        session = self.session
        self._name()
        if session.task not in self._plots:
            self._plots[session.task] = self._new_plots()
            with self._drive:
                self._sliders[session.task] = [
                    self.client.gui.add_slider(f"{c.label} [{c.unit}]", 0.0, round(c.most, 2), 0.01, 0.0)
                    for c in session.controls
                ]
        for task in self._plots:
            for plot in self._plots[task]:
                plot.visible = task == session.task
            for slider in self._sliders[task]:
                slider.visible = task == session.task
        for slider in self._sliders[session.task]:
            slider.value = 0.0  # type: ignore[misc]  # viser has a setter
        with self.client.atomic():
            self._draw()
            self._tell()

    def _name(self) -> None:
        """Say which task it is and what drives the arm."""
        self.client.gui.set_panel_label(f"{registry.entry(self.session.task).title}, {self.session.controller}")

    def _new_plots(self) -> list[viser.GuiUplotHandle]:
        """Return plots of temperatures and tensions of the session's TCAs."""
        names = [control.label for control in self.session.controls]
        times, temperatures, tensions = self.session.history()
        with self._readings:
            return [
                chart(
                    self.client.gui, label, names[: values.shape[1]], interval, series(times, values, self.session.core.step_s)
                )
                for label, interval, values in (("temperature [°C]", HOT, temperatures), ("tension [mN]", TIGHT, tensions))
            ]

    def _draw(self) -> None:
        """Show the arm as it is."""
        # A browser shows nothing where an opaque mesh gives way to a translucent one of the same name, as goals of tasks do.
        parts = {f"{self.session.task}/{name}": part for name, part in self.session.parts().items()}
        scale = SCALE * (TABLE / self.session.env.task.ground)
        for name, part in parts.items():
            colour = rgb(part)
            if name not in self._meshes:
                mesh = self.client.scene.add_mesh_simple(
                    f"/{name}", scale * part.vertices, part.triangles, color=colour,
                    opacity=None if part.opacity == 1.0 else part.opacity, cast_shadow=part.opacity == 1.0,
                )  # fmt: skip
            else:
                mesh, before = self._meshes[name]
                if not np.array_equal(part.vertices, before.vertices):
                    mesh.vertices = (scale * part.vertices).astype(np.float32)
                if colour != rgb(before):
                    mesh.color = colour
            self._meshes[name] = mesh, part
        for name in self._meshes.keys() - parts.keys():
            self._meshes.pop(name)[0].remove()

    def _tell(self) -> None:
        """Show plots, numbers, and what a policy does."""
        session = self.session
        times, temperatures, tensions = session.history()
        for plot, values in zip(self._plots[session.task], (temperatures, tensions), strict=True):
            plot.data = series(times, values, session.core.step_s)
        self._numbers.content = readings(session)
        if session.controller != MANUAL:
            for slider, value in zip(self._sliders[session.task], session.command.tolist(), strict=True):
                slider.value = min(round(value, 2), slider.max)  # type: ignore[misc]  # viser has a setter


def within(given: Any) -> float:
    """Return the number of a slider or a box, in its range: while a visitor types a browser sends what is not."""
    return float(np.clip(given.value, given.min, given.max))


def chart(
    gui: viser.GuiApi, label: str, names: list[str], interval: tuple[float, float], data: tuple[Array, ...]
) -> viser.GuiUplotHandle:
    """Return a plot of columns of data over the first one, a line for each name."""
    lines = [uplot.Series(label=name, stroke=LINES[i % len(LINES)], width=2) for i, name in enumerate(names)]
    return gui.add_uplot(
        data,
        (uplot.Series(label="time [s]"), *lines),
        scales={"x": uplot.Scale(time=False), "y": uplot.Scale(range=interval)},
        axes=(
            uplot.Axis(label="time [s]", font=FONT, labelFont=FONT, ticks=TICKS, gap=2.0, size=22.0, labelSize=16.0),
            uplot.Axis(label=label, font=FONT, labelFont=FONT, ticks=TICKS, gap=2.0, size=34.0, labelSize=18.0),
        ),
        legend=uplot.Legend(show=True, live=False),
        height=PLOT,
        padding=(6, 8, 0, 0),
    )


def series(times: Array, values: Array, step_s: float) -> tuple[Array, ...]:
    """Return times and columns of values for a plot; what is to come of its shortest span is blank."""
    missing = max(round(SHORTEST_S / step_s) + 1 - len(times), 0)
    return (
        np.concatenate([times, times[-1] + step_s * np.arange(1, missing + 1)]),
        *(np.concatenate([column, np.full(missing, np.nan)]) for column in values.T),
    )


def rgb(part: Part) -> tuple[int, int, int]:
    """Return a part's colour, 0 to 255: of its temperature where it has one."""
    if part.temperature is None:
        red, green, blue = bytes.fromhex(part.colour[1:])
    else:
        red, green, blue = np.rint(255.0 * heat_colour(part.temperature)).astype(int).tolist()
    return red, green, blue


def readings(session: Session) -> str:
    """Return HTML with the task's and the solver's numbers, and the colours of temperatures."""
    info, solve, chosen = session.info, session.solve, session.env.arm.discretisation
    assert chosen.tolerance is not None and chosen.error is not None
    task = {"time": f"{session.time:.1f} s"}
    for name in [name for name in info if name not in ("is_success", "energy_J", "cost", "solver")]:
        what, _, unit = name.rpartition("_")
        task[what.replace("_", " ")] = f"{info[name]:.1f}°" if unit == "deg" else f"{info[name]:.2f} {unit}"
    task |= {"success": "yes" if info["is_success"] else "no", "energy": f"{info['energy_J']:.1f} J"}
    solver = {
        "step took": f"{solve.milliseconds:.2f} ms",
        "rung": f"{solve.rung.name}: {RUNGS[solve.rung]}",
        "iterations": f"{solve.iterations}",
        "residual": f"{solve.residual:.0e}",
        "converged": "yes" if solve.converged else "no",
        "jumped": "yes" if solve.jumped else "no",
        "stability": f"{solve.stability:.3f}, {'stable' if solve.stable else 'unstable'}",
        "grid": session.discretisation(),
        "tip error": f"{length(chosen.error)} of {length(chosen.tolerance)}",
    }
    stops = ", ".join(f"rgb({r:.0f} {g:.0f} {b:.0f})" for r, g, b in 255.0 * HEAT)
    bar = (
        f'<div style="height:0.6em;border-radius:2px;background:linear-gradient(to right, {stops})"></div>'
        f'<div style="display:flex;justify-content:space-between"><span>{AMBIENT:.0f} °C</span><span>colour of the coils</span>'
        f"<span>{HARD_LIMIT:.0f} °C</span></div>"
    )
    content = table("Task", task) + table("Solver", solver) + bar
    return f'<div style="font-size:0.8em;line-height:1.3;padding:0.2em 0.8em">{content}</div>'


def length(metres: float) -> str:
    """Return a length in two digits and a unit that fits."""
    factor, unit = next((f, u) for f, u in ((1e3, "mm"), (1e6, "µm"), (1e9, "nm")) if metres * f >= 0.95 or u == "nm")
    return f"{float(f'{factor * metres:.2g}'):g} {unit}"


def table(title: str, rows: dict[str, str]) -> str:
    """Return an HTML table of names and values."""
    cells = "".join(
        f'<tr><td style="color:#666;width:6.5em">{n}</td><td data-reading="{n}">{v}</td></tr>' for n, v in rows.items()
    )
    return f'<b>{title}</b><table style="width:100%;margin-bottom:0.5em;font-variant-numeric:tabular-nums">{cells}</table>'
