"""Pictures of an arm by PyVista: what `geometry` makes of a lane, lit, with a shadow, a colour bar and a readout.

Off screen it needs no display, but some OpenGL: that of a graphics driver or Mesa's in software.
"""

import importlib.util
import os
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from tca_envs import batch, geometry, presets
from tca_envs.geometry import Part
from tca_envs.mechanics.thermal import AMBIENT, HARD_LIMIT
from tca_envs.tasks.core import STEP_S, Core
from tca_envs.tasks.task import Task

Array = NDArray[np.float64]
Point = tuple[float, float, float]

MODES = ("rgb_array", "depth_array", "human")
FPS = round(1.0 / STEP_S)
"""Frames per second: a step is shown for as long as it lasts."""
CAMERAS: Mapping[str, tuple[Point, Point]] = {
    "front": ((70e-3, 270e-3, 10e-3), (0.0, 0.0, 39e-3)),
    "side": ((270e-3, 60e-3, 10e-3), (0.0, 0.0, 39e-3)),
    "above": ((60e-3, 190e-3, -110e-3), (0.0, 0.0, 48e-3)),
    "gripper": ((40e-3, 110e-3, 50e-3), (0.0, 0.0, 70e-3)),
}
"""Where cameras stand and at what they look [m] in the base frame with the stage up, z down."""
MOST_PIXELS = 4096
SUN = np.array([0.35, -0.25, 1.0])
"""Direction of the light that casts the shadow, onto the table: (x, y) over z."""
BACKGROUND, INK = "#ffffff", "#22262b"
SHADOW = "#cfcfca"
MM = 1e3
"""Scenes are in millimetres: VTK's defaults suit numbers of about that size."""


def checked(render_mode: Any, width: Any, height: Any, camera: Any, modes: Sequence[str] = MODES) -> "Renderer | None":
    """Return a renderer, or None for the render mode None.

    Parameters
    ----------
    render_mode : str or None
        One of `modes`.
    width, height : int
        Of pictures [pixel].
    camera : str or pair of (3,) arrays
        Name in CAMERAS, or where it stands and at what it looks [m] in the base frame with the stage up, z down.
    modes : sequence of str
        What is possible.

    Raises
    ------
    ValueError
        If an argument is none of these.
    DependencyNotInstalled
        If a mode is asked for and PyVista is missing.
    """
    if render_mode is not None and (not isinstance(render_mode, str) or render_mode not in modes):
        raise ValueError(f"render_mode = {render_mode!r}: expected None or one of {', '.join(map(repr, modes))}")
    for name, value in (("width", width), ("height", height)):
        if not isinstance(value, int | np.integer) or isinstance(value, bool) or not 16 <= value <= MOST_PIXELS:
            raise ValueError(f"{name} = {value!r}: expected an integer number of pixels, 16 to {MOST_PIXELS}")
    place = _camera(camera)
    if render_mode is None:
        return None
    if importlib.util.find_spec("pyvista") is None:
        raise DependencyNotInstalled(f'render_mode = {render_mode!r} needs PyVista: pip install "tca_envs[render]"')
    return Renderer(render_mode, int(width), int(height), place)


def _camera(camera: Any) -> tuple[Array, Array]:
    if isinstance(camera, str) and camera in CAMERAS:
        camera = CAMERAS[camera]
    try:
        stand, target = np.array(camera, dtype=np.float64)
        good = stand.shape == (3,) and np.isfinite([stand, target]).all() and np.linalg.norm(np.cross(target - stand, [0, 0, 1])) > 0
    except (TypeError, ValueError):
        good = False
    if not good:
        raise ValueError(
            f"camera = {camera!r}: expected {', '.join(map(repr, CAMERAS))}, or two points of three finite numbers [m], where it "
            "stands and at what it looks, not straight above each other"
        )
    return stand, target


class Renderer:
    """Draws lanes of one task; see `checked`. What it holds of OpenGL is made by the first picture and not copied or pickled."""

    def __init__(self, mode: str, width: int, height: int, camera: tuple[Array, Array]) -> None:
        self.mode = mode
        self.size = (width, height)
        self.camera = camera
        self._scene: _Scene | None = None
        self._due = 0.0  # when the next frame is to be shown

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_scene": None}

    def render(self, task: Task, core: Core, lane: int = 0) -> NDArray[Any] | None:
        """Return the picture of a lane, (height, width, 3) uint8 or, as depth, (height, width) float32 [m]; None for a window.

        The depth is the distance from the camera's plane, infinite where nothing is. A window is shown at FPS; what is drawn
        after a user closed it is lost.

        Raises
        ------
        RuntimeError
            If there is no OpenGL, or no display for a window.
        """
        parts = geometry.parts(task, core, lane)
        if self._scene is None:
            self._scene = _Scene(self.size, self.camera, parts, window=self.mode == "human")
        self._scene.show(parts, readout(task, core, lane))
        if self.mode == "human":
            self._due = max(self._due, time.perf_counter()) if self._due else time.perf_counter()
            self._scene.wait(self._due)
            self._due += 1.0 / FPS
            return None
        return self._scene.depth() if self.mode == "depth_array" else self._scene.image()

    def close(self) -> None:
        """Release the window and what is held of OpenGL."""
        if self._scene is not None:
            self._scene.close()
        self._scene = None


def readout(task: Task, core: Core, lane: int) -> str:
    """Return what a picture says of a lane: time, temperatures, how far the goal is, success."""
    record = core.record
    outcome = batch.outcome(task, task.achieved(record)[lane], record.goal[lane])
    measures = []
    for name, value in outcome.measures.items():
        what, unit = name.rsplit("_", 1)
        measures.append(f"{what.replace('_', ' ')} {float(value):.1f}{'°' if unit == 'deg' else f' {unit}'}")
    heat = " / ".join(f"{value:.0f}" for value in record.temperature[lane])
    return "\n".join(
        [f"{STEP_S * int(record.steps[lane]):.1f} s", f"{heat} °C", *measures, "success" if outcome.success else ""]
    )


class _Scene:
    """A PyVista plotter with an actor for each part; parts of the same names come with every picture."""

    def __init__(self, size: tuple[int, int], camera: tuple[Array, Array], parts: Mapping[str, Part], window: bool) -> None:
        import pyvista

        self.plotter = _plotter(pyvista, size, window)
        self.meshes, self.actors = {}, {}
        for name, part in parts.items():
            mesh = pyvista.PolyData.from_regular_faces(np.zeros_like(part.vertices, dtype=np.float32), part.triangles)
            mesh.point_data.active_normals = np.zeros_like(part.vertices, dtype=np.float32)
            shiny = part.temperature is not None or part.colour == geometry.METAL
            self.meshes[name] = mesh
            self.actors[name] = self.plotter.add_mesh(
                mesh, color=part.colour, opacity=part.opacity, smooth_shading=False, ambient=0.25, diffuse=0.75,
                specular=0.35 if shiny else 0.08, specular_power=25, show_scalar_bar=False, reset_camera=False,
            )  # fmt: skip
            self.actors[name].prop.interpolation = "phong"
