"""Pictures of an arm by PyVista: what a task shows of a lane, lit, with a shadow, a colour bar and a readout.

Off screen it needs no display, but some OpenGL: that of a graphics driver or Mesa's in software.
"""

import importlib
import importlib.util
import time
import weakref
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from tca_envs import geometry
from tca_envs.geometry import Part
from tca_envs.mechanics.thermal import AMBIENT, HARD_LIMIT
from tca_envs.robots.paper import TABLE
from tca_envs.tasks.core import Core
from tca_envs.tasks.task import Task

Array = NDArray[np.float64]
Point = tuple[float, float, float]

Camera = str | tuple[Point, Point] | NDArray[np.float64]

SIZE = 480
"""Default width and height of pictures [pixel]."""
MODES = ("rgb_array", "depth_array", "human")
CAMERAS: Mapping[str, tuple[Point, Point]] = {
    "front": ((70e-3, 270e-3, 10e-3), (0.0, 0.0, 41e-3)),
    "side": ((270e-3, 60e-3, 10e-3), (0.0, 0.0, 39e-3)),
    "above": ((90e-3, 240e-3, -70e-3), (0.0, 0.0, 43e-3)),
    "gripper": ((50e-3, 165e-3, 40e-3), (0.0, 0.0, 65e-3)),
}
"""Where cameras stand and at what they look [m] in the base frame with the stage up, z down: over the paper's table. Over one
that is deeper they stand further away in proportion, as lamps do."""
MOST_PIXELS = 4096
SUN = np.array([0.35, -0.25, 1.0])
"""Direction of the light that casts the shadow, onto the table: (x, y) over z."""
BACKGROUND, INK = "#ffffff", "#22262b"
SHADOW = "#bdbfc2"
LIGHTS: Sequence[tuple[Point, float]] = (((-150e-3, 200e-3, -250e-3), 0.8), ((200e-3, 150e-3, -60e-3), 0.45))
"""Where lamps stand [m] and how bright they are."""
CENTRE = np.array([0.0, 0.0, 45e-3])
"""At what they point [m]."""
VIEW_DEG = 24.0
"""Height of a camera's view."""
FINER = 2
"""Pictures are drawn with so many pixels for one, each way, against jagged edges: coils are a few pixels wide."""
AMBIENT_LIGHT = {"table": 0.45}
SHADOWLESS = ("stage", "column", "table")
HEAT_SCALE = np.linspace(AMBIENT, HARD_LIMIT, 256)
MM = 1e3
"""Scenes over the paper's table are in millimetres: VTK's defaults suit numbers of about that size. Others are scaled to it."""


def fps(step_s: float) -> float:
    """Return frames per second at which a step is shown for as long as it lasts [s]; an integer where that is near."""
    rate = 1.0 / step_s
    return round(rate) if abs(rate - round(rate)) < 1e-6 * rate else rate


def new_renderer(render_mode: Any, width: Any, height: Any, camera: Any, modes: Sequence[str] = MODES) -> "Renderer | None":
    """Return what draws, or None for the render mode None.

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


def _camera(camera: Any) -> str | tuple[Array, Array]:
    """Return the name of a camera, or where it stands and at what it looks [m]."""
    if isinstance(camera, str) and camera in CAMERAS:
        return camera
    try:
        stand, target = np.array(camera, dtype=np.float64)
        good = stand.shape == (3,) and bool(np.isfinite([stand, target]).all() and (stand[:2] != target[:2]).any())
    except (TypeError, ValueError):
        good = False
    if not good:
        raise ValueError(
            f"camera = {camera!r}: expected {', '.join(map(repr, CAMERAS))}, or two points of three finite numbers [m], where "
            "it stands and at what it looks, not straight above each other"
        )
    return stand, target


class Renderer:
    """Draws lanes of one task, see `new_renderer`. What it holds of OpenGL comes with the first picture, and no copy has it."""

    def __init__(self, mode: str, width: int, height: int, camera: str | tuple[Array, Array]) -> None:
        self.mode = mode
        self.size = (width, height)
        self.camera = camera
        self._scene: _Scene | None = None
        self._step = -1  # that the window shows
        self._due = 0.0  # when the frame that is shown has been for long enough, in the time of `time.perf_counter`

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_scene": None, "_due": 0.0, "_step": -1}

    def render(self, task: Task, core: Core, lane: int = 0) -> Any:
        """Return the picture of a lane, (height, width, 3) uint8 or, as depth, (height, width) float32 [m]; None for a window.

        The depth is the distance from the camera's plane, infinite where nothing is. A window shows a step for as long as it
        lasts; what is drawn after a user closed it is lost.

        Raises
        ------
        RuntimeError
            If there is no OpenGL, or no display for a window.
        """
        if self._scene is not None and self._scene.closed:
            return None
        parts = task.parts(core, lane)
        if self._scene is None:
            self._scene = _Scene(self.size, self.camera, parts, self.mode, task.ground)
            # PyVista keeps every plotter until it is closed, and many environments never are.
            weakref.finalize(self, self._scene.close).atexit = False
        self._scene.show(parts, readout(task, core, lane))
        if self.mode == "human":
            step = int(core.record.steps[lane])
            if step != self._step:  # who draws a step again does not make it longer
                self._step, self._due = step, max(self._due, time.perf_counter())
                self._scene.wait(self._due)
                self._due += task.step_s
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
    outcome = task.outcome(task.achieved(record)[lane], record.goal[lane])
    measures = []
    for name, value in outcome.measures.items():
        what, _, unit = name.rpartition("_")
        measures.append(f"{what.replace('_', ' ')} {float(value):.1f}{'°' if unit == 'deg' else f' {unit}'}")
    heat = " / ".join(f"{value:.0f}" for value in record.temperature[lane])
    return "\n".join(
        [f"{task.step_s * int(record.steps[lane]):.1f} s", f"{heat} °C", *measures, "success" if outcome.success else ""]
    )


class _Scene:
    """A PyVista plotter with an actor for each part; every picture comes with parts of the same names."""

    def __init__(
        self, size: tuple[int, int], camera: str | tuple[Array, Array], parts: Mapping[str, Part], mode: str, ground: float
    ) -> None:
        window, annotated = mode == "human", mode != "depth_array"
        pyvista: Any = importlib.import_module("pyvista")  # takes a second, and its types are too narrow for arrays of 32 bits
        self.unit, self.ground = MM * (TABLE / ground), ground
        width, height = size if window else (FINER * size[0], FINER * size[1])
        self.plotter = plotter = _plotter(pyvista, (width, height), window)
        self.meshes, self.actors = {}, {}
        for name, part in parts.items():
            mesh = pyvista.PolyData.from_regular_faces(part.vertices.astype(np.float32), part.triangles)
            mesh.point_data.active_normals = part.normals.astype(np.float32)
            light = AMBIENT_LIGHT.get(name, 0.35)
            shine = 0.4 if part.temperature is not None or part.colour == geometry.METAL else 0.1
            self.meshes[name] = mesh
            self.actors[name] = plotter.add_mesh(
                mesh, color=part.colour, opacity=part.opacity, ambient=light, diffuse=0.7, specular=shine, specular_power=25.0,
                culling="back", reset_camera=False,
            )  # fmt: skip
            self.actors[name].prop.interpolation = "phong"  # by the part's own normals
        self.casters = [name for name, part in parts.items() if name not in SHADOWLESS and part.opacity == 1.0]
        first = np.cumsum([0] + [len(parts[name].vertices) for name in self.casters])
        triangles = np.concatenate([parts[name].triangles + n for name, n in zip(self.casters, first[:-1], strict=True)])
        self.shadow = pyvista.PolyData.from_regular_faces(np.zeros((first[-1], 3), dtype=np.float32), triangles)
        plotter.add_mesh(self.shadow, color=SHADOW, lighting=False, reset_camera=False)
        for place, strength in LIGHTS:
            plotter.add_light(pyvista.Light(position=MM * np.array(place), focal_point=MM * CENTRE, intensity=strength))
        self.text = self._annotated(pyvista, width, height) if annotated else None
        stand, target = MM * np.array(CAMERAS[camera]) if isinstance(camera, str) else self.unit * np.array(camera)
        plotter.camera.position, plotter.camera.focal_point = stand, target
        plotter.camera.up = (0.0, 0.0, -1.0)
        plotter.camera.view_angle = VIEW_DEG
        if window:
            plotter.enable_anti_aliasing("fxaa")
        else:  # VTK's own ways against jagged edges take longer than FINER
            plotter.disable_anti_aliasing()
        plotter.show(auto_close=False, interactive_update=window, interactive=False)
        self.closed = False
        if window:
            plotter.iren.add_observer("ExitEvent", self._leave)

    def _leave(self, *_: Any) -> None:
        """Note that the user closed the window; it goes once its events are done."""
        self.closed = True

    def _annotated(self, pyvista: Any, width: int, height: int) -> Any:
        """Add colour bar and readout, as large as the shorter edge allows; returns the latter."""
        edge = min(width, height)
        across, up = edge / width, edge / height
        size = round(0.026 * edge)
        table = pyvista.LookupTable(values=np.hstack([255.0 * geometry.heat_colour(HEAT_SCALE), np.full((256, 1), 255.0)]))
        table.scalar_range = AMBIENT, HARD_LIMIT
        mapper = pyvista.DataSetMapper(pyvista.Sphere())
        mapper.lookup_table = table
        self.plotter.add_scalar_bar(
            "°C", mapper=mapper, vertical=True, n_labels=4, fmt="%.0f", color=INK, title_font_size=size, label_font_size=size,
            width=0.07 * across, height=0.4 * up, position_x=1.0 - 0.1 * across, position_y=1.0 - 0.48 * up,
            unconstrained_font_size=True,
        )  # fmt: skip
        text = self.plotter.add_text("", position=(0.0, 0.0), font_size=1, color=INK)
        text.prop.font_size = size
        text.prop.SetVerticalJustificationToTop()
        text.SetPosition(0.03 * edge, height - 0.03 * edge)
        return text

    def show(self, parts: Mapping[str, Part], text: str) -> None:
        """Draw parts and a readout."""
        for name, part in parts.items():
            _write(self.meshes[name], self.unit * part.vertices, part.normals)
            colour = part.colour if part.temperature is None else geometry.heat_colour(part.temperature)
            self.actors[name].prop.color = colour
        thrown = self.unit * np.concatenate([parts[name].vertices for name in self.casters])
        ground = self.unit * self.ground - 0.05
        edge = self.unit * self.ground * geometry.TABLE_HALF
        thrown[:, :2] += (ground - thrown[:, 2:]) * SUN[:2]
        np.clip(thrown[:, :2], -edge, edge, out=thrown[:, :2])
        thrown[:, 2] = ground
        _write(self.shadow, thrown)
        if self.text is not None:
            self.text.input = text
        self.plotter.renderer.ResetCameraClippingRange()
        self.plotter.render()

    def image(self) -> NDArray[np.uint8]:
        """Return the picture (height, width, 3)."""
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkCommonCore import vtkUnsignedCharArray

        window, found = self.plotter.render_window, vtkUnsignedCharArray()
        width, height = window.GetSize()
        window.GetPixelData(0, 0, width - 1, height - 1, 0, found, 0)
        window.ReleaseCurrent()  # another thread may ask for the next one
        rows = vtk_to_numpy(found).reshape(height // FINER, FINER, -1)[::-1]
        total = sum(rows[:, i].astype(np.uint16) for i in range(FINER)).reshape(height // FINER, width // FINER, FINER, 3)
        return (sum(total[:, :, i] for i in range(FINER)) // FINER**2).astype(np.uint8)

    def depth(self) -> NDArray[np.float32]:
        """Return the distances from the camera's plane (height, width) [m]."""
        deep = -self.plotter.get_image_depth(fill_value=-np.inf, reset_camera_clipping_range=False)
        self.plotter.render_window.ReleaseCurrent()
        return np.ascontiguousarray(deep[::FINER, ::FINER] / self.unit, dtype=np.float32)

    def wait(self, until: float) -> None:
        """Let the mouse turn the window until a time of `time.perf_counter`."""
        while True:
            self.plotter.iren.process_events()
            if self.closed:
                self.plotter.close()
                break
            left = until - time.perf_counter()
            if left <= 0.0:
                break
            time.sleep(min(left, 0.01))

    def close(self) -> None:
        """Release it."""
        self.plotter.close()


def _plotter(pyvista: Any, size: tuple[int, int], window: bool) -> Any:
    """Return an empty plotter; RuntimeError where it cannot draw."""
    from vtkmodules.vtkCommonCore import vtkLogger

    # VTK warns of each kind of OpenGL that it does not find before one that it does, and crashes at the first picture if it
    # finds none.
    verbosity = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    try:
        plotter = pyvista.Plotter(off_screen=not window, window_size=size, lighting="none", title="tca_envs", notebook=False)
        kind = plotter.render_window.GetClassName()
        if window and kind in ("vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow"):
            plotter.close()
            raise RuntimeError(
                "render_mode = 'human' needs a display to open a window on, and there is none (DISPLAY on Linux); "
                "'rgb_array' needs none"
            )
        plotter.render_window.Initialize()
        if not window and plotter.render_window.GetGenericContext() is None:
            plotter.close()
            raise RuntimeError(
                "no OpenGL to draw with: neither a display nor EGL nor OSMesa was found; Mesa draws in software, on Debian and "
                "Ubuntu: apt install libegl1 libgl1-mesa-dri"
            )
    finally:
        vtkLogger.SetStderrVerbosity(verbosity)
    plotter.set_background(BACKGROUND)
    # Ghosts are convex or far from each other: blending them in any order is right enough, and twice as fast.
    plotter.renderer.SetUseOIT(False)
    return plotter


def _write(mesh: Any, points: Array, normals: Array | None = None) -> None:
    """Move a mesh's points (v, 3) and turn its normals."""
    mesh.points[...] = points
    mesh.GetPoints().Modified()
    if normals is not None:
        mesh.point_data.active_normals[...] = normals
        mesh.GetPointData().GetNormals().Modified()
