"""The viewer: what a visitor plays with, without a page; the command line; and the page in a real headless Chromium."""

import io
import re
import shutil
import socket
import sys
import threading
import time
from collections.abc import Callable
from importlib.util import find_spec

import gymnasium as gym
import numpy as np
import pytest

from tca_envs.mechanics import Rung, grasp
from tca_envs.viewer import session as module
from tca_envs.viewer.__main__ import main
from tca_envs.viewer.session import Session, World

IDS = {"reach": "TCAReachDense-v0", "twist-align": "TCATwistAlignDense-v0", "pick-and-place": "TCAPickAndPlaceDense-v0"}


def test_there_is_a_control_for_everything_that_an_action_holds():
    controls = Session("pick-and-place").controls
    assert [control.label for control in controls] == ["Bend 0°", "Bend 120°", "Bend 240°", "Twist", "Grip", "Stage"]
    assert [control.unit for control in controls] == ["W"] * 5 + ["mm"]
    assert [control.most for control in controls] == pytest.approx([2.0, 2.0, 2.0, 4.94, 2.25, 15.0], abs=0.005)
    assert len(Session("reach").controls) == 3 and len(Session("twist-align").controls) == 4


@pytest.mark.parametrize("task", IDS)
def test_a_session_is_the_environment_with_powers_in_watts(task):
    env = gym.make(IDS[task]).unwrapped
    observation, _ = env.reset(seed=3)
    session = Session(task, seed=3)
    np.testing.assert_array_equal(session.observation["desired_goal"], observation["desired_goal"])
    session.command[0] = 1.5
    action = -np.ones(len(session.controls))
    action[0], action[5:] = 0.5, 0.0
    for _ in range(20):
        session.step()
        observation, _, _, _, info = env.step(action)
    for key, values in observation.items():
        np.testing.assert_array_equal(session.observation[key], values)
    assert session.info == info and session.time == pytest.approx(2.0)
    assert session.solve.rung == Rung(info["solver"]["rung"]) and session.solve.milliseconds > 0.0


def test_the_stage_goes_to_where_it_is_asked_to():
    session = Session("pick-and-place")
    session.command[5] = 2.5
    travel = []
    for _ in range(4):
        session.step()
        travel.append(1e3 * session.core.record.scene[0, grasp.STAGE])
    assert travel == pytest.approx([1.0, 2.0, 2.5, 2.5])


def test_gravity_bends_the_arm_to_where_it_pulls():
    session = Session("twist-align")
    session.world = World(gravity=0.5, tilt=90.0)
    for _ in range(3):
        session.step()
    assert session.core.load[6:9] == pytest.approx([0.5 * 9.81, 0.0, 0.0])
    assert session.core.record.tip[0, 0, 3] > 5e-3
    session.world = World(gravity=-1.0)
    for _ in range(3):
        session.step()
    assert session.core.load[6:9] == pytest.approx([0.0, 0.0, -9.81])
    assert session.solve.converged and session.solve.stable


@pytest.mark.parametrize("task", IDS)
def test_a_payload_pulls_at_the_arm_and_goes_with_its_slider(task):
    session, free = Session(task), Session(task)
    session.world = World(payload=5.0)
    for each in (session, free):
        each.command[0] = 1.5
        for _ in range(30):
            each.step()
    assert session.core.record.load[0, 9] == pytest.approx(free.core.record.load[0, 9] + 5e-3)
    assert session.core.record.tip[0, 0, 3] < free.core.record.tip[0, 0, 3] - 1e-3
    session.world = World()
    for _ in range(2):
        session.step()
    assert session.core.record.load[0, 9] == pytest.approx(free.core.record.load[0, 9])


def test_goals_do_not_depend_on_the_world():
    session = Session("twist-align", seed=5)
    goal = session.observation["desired_goal"]
    session.world = World(gravity=-1.0, tilt=20.0, payload=5.0)
    session.step()
    session.reset(5)
    np.testing.assert_array_equal(session.observation["desired_goal"], goal)
    assert session.time == 0.0 and not session.command.any()


def test_stability_is_that_of_the_equilibrium():
    session = Session("reach")
    session.command[:] = [1.2, 0.4, 0.0]
    for _ in range(40):
        session.step()
    known = session.env.arm.equilibrium(session.core.record.temperature[0])
    assert session.solve.stability == pytest.approx(known.stability, abs=1e-4) and session.solve.stable


def test_history_is_the_last_half_minute():
    session = Session("reach")
    session.command[1] = 1.0
    for _ in range(310):
        session.step()
    times, temperatures, tensions = session.history()
    assert times == pytest.approx(np.arange(10, 311) / 10.0)
    assert temperatures.shape == tensions.shape == (301, 3)
    np.testing.assert_array_equal(temperatures[-1], session.core.record.temperature[0])
    np.testing.assert_array_equal(tensions[-1], 1e3 * session.core.record.tension[0])
    session.reset(0)
    assert [len(values) for values in session.history()] == [1, 1, 1]


@pytest.mark.parametrize("controller", ["scripted", "pretrained"])
def test_others_can_drive(controller):
    if missing := module.CONTROLLERS[controller].missing("reach"):
        pytest.skip(f"{controller}: {missing}")
    session = Session("reach", seed=1)
    session.drive_by(controller)
    session.step()
    np.testing.assert_array_equal(session.command, session.core.record.power[0])
    for _ in range(40):
        session.step()
    assert session.info["is_success"]
    session.reset(2)
    for _ in range(40):
        session.step()
    assert session.info["is_success"] and session.controller == controller
    session.drive_by("manual")
    session.command[:] = 0.0
    session.step()
    assert not session.core.record.power.any()


def test_a_controller_that_is_not_there_says_what_is_missing(monkeypatch):
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    assert module.CONTROLLERS["scripted"].missing("reach") == "needs the package `agents` of a checkout"
    assert "agents" in module.CONTROLLERS["pretrained"].missing("reach")
    session = Session("reach")
    with pytest.raises(ValueError, match=r"controller = 'scripted': expected one of 'manual'$"):
        session.drive_by("scripted")
    assert session.controller == "manual"


def test_without_stable_baselines_there_is_no_pretrained_policy(monkeypatch):
    monkeypatch.setattr(module, "find_spec", lambda name: None if name == "stable_baselines3" else find_spec(name))
    assert module.CONTROLLERS["pretrained"].missing("reach") == 'needs pip install "tca_envs[train]"'


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Session("fly"), "task = 'fly': expected one of 'reach'"),
        (lambda: Session("reach", tolerance=1.0), r"tolerance = 1.0: expected a finite number in \[1e-09, 0.001\]"),
        (lambda: Session("reach", seed=-1), "seed = -1: expected an integer of at least 0"),
        (lambda: Session("reach").drive_by("magic"), "controller = 'magic': expected one of 'manual'"),
        (lambda: World(gravity=2.0), r"gravity = 2.0: expected a finite number in \[-1, 1\]"),
        (lambda: World(tilt=91.0), r"tilt = 91.0: expected a finite number in \[-90, 90\]"),
        (lambda: World(payload=-1.0), r"payload = -1.0: expected a finite number in \[0, 5\]"),
    ],
)
def test_bad_input_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--port", "70000"], "--port 70000: expected a number from 0 to 65535"),
        (["--host", "192.0.2.1", "--port", "0"], "--host 192.0.2.1 --port 0: expected this machine's address and a free port"),
        (["--port", "TAKEN"], "expected this machine's address and a free port"),
    ],
)
def test_the_command_line_refuses_what_it_cannot_bind_to(arguments, message, capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(SystemExit) as exit:
        main([argument.replace("TAKEN", str(taken.getsockname()[1])) for argument in arguments])
    assert exit.value.code == 2 and message in capsys.readouterr().err


def test_without_viser_the_command_line_says_what_to_install(monkeypatch, capsys):
    for name in ("tca_envs.viewer.page", "tca_envs.viewer.server"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(SystemExit) as exit:
        main(["--port", "0"])
    assert exit.value.code == 2 and 'pip install "tca_envs[viewer]"' in capsys.readouterr().err


def test_readings_tell_of_task_and_solver():
    pytest.importorskip("viser", reason="needs viser: the extra `viewer`")
    from tca_envs.viewer.page import length, readings

    session = Session("twist-align", tolerance=1e-3)
    session.step()
    told = dict(re.findall(r'data-reading="([^"]*)">([^<]*)<', readings(session)))
    assert told["time"] == "0.1 s" and told["distance"] == f"{session.info['distance_mm']:.2f} mm" and told["success"] == "no"
    assert told["yaw error"] == f"{session.info['yaw_error_deg']:.1f}°" and told["energy"] == "0.0 J"
    assert told["rung"].startswith("WARM") and told["converged"] == "yes" and told["jumped"] == "no"
    assert told["stability"].endswith(", stable") and told["grid"] == "1 × 5 + 4 × 4 Gauss nodes"
    assert told["tip error"] == f"{length(session.env.arm.discretisation.error)} of 1 mm"
    assert [length(x) for x in (1e-3, 3.21e-4, 1e-5, 9.8e-7, 2.7e-9)] == ["1 mm", "320 µm", "10 µm", "0.98 µm", "2.7 nm"]


SOFTWARE = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
"""WebGL without a graphics card."""


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api", reason="needs Playwright: the extra `test`")
    with playwright.sync_playwright() as running:
        own = running.chromium.executable_path
        path = next(filter(None, map(shutil.which, (own, "chromium", "chromium-browser", "google-chrome"))), None)
        if path is None:
            pytest.skip("needs a Chromium: playwright install chromium")
        chromium = running.chromium.launch(executable_path=path, args=["--no-sandbox", *SOFTWARE])
        yield chromium
        chromium.close()


@pytest.fixture(scope="module")
def viewer():
    pytest.importorskip("viser", reason="needs viser: the extra `viewer`")
    from tca_envs.viewer.server import Viewer

    running = Viewer(port=0)
    yield running
    running.stop()


class Visitor:
    """A browser's page, and the server's side of it."""

    def __init__(self, browser, viewer):
        before = set(viewer.pages)
        self.requests, self.errors = [], []
        self.context = browser.new_context(viewport={"width": 900, "height": 600})
        self.page = self.context.new_page()
        self.page.set_default_timeout(30_000)
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("websocket", lambda websocket: self.requests.append(websocket.url))
        self.page.on("console", lambda said: self.errors.append(said.text) if said.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(viewer.url)
        self.page.get_by_text("Gravity [g]").wait_for()
        (self.number,) = set(viewer.pages) - before
        self.server = viewer.pages[self.number]
        self.press("Pause")
        until(lambda: not self.server.running)
        for note in self.page.locator(".mantine-Notification-closeButton").all():  # of viser: there is no graphics card
            note.click()

    def press(self, name):
        self.page.get_by_role("button", name=name, exact=True).click()

    def slider(self, label):
        return self.page.locator(f'[id="{self.page.get_by_text(label, exact=True).get_attribute("for")}"]')

    def drag(self, label, share):
        """Drag a slider's thumb with the mouse to a share of its way."""
        rail, thumb = self.slider(label).bounding_box(), self.slider(label).get_by_role("slider").bounding_box()
        mouse, height = self.page.mouse, thumb["y"] + 0.5 * thumb["height"]
        mouse.move(thumb["x"] + 0.5 * thumb["width"], height)
        mouse.down()
        mouse.move(rail["x"] + share * rail["width"], height, steps=3)
        mouse.up()

    def picture(self):
        """The arm, as pixels (h, w, 3)."""
        import imageio.v3 as imageio

        self.page.wait_for_timeout(500)  # what was sent is drawn
        return imageio.imread(io.BytesIO(self.page.locator("canvas").first.screenshot()))[..., :3].astype(int)

    def run(self, enough: Callable[[], bool]):
        self.press("Run")
        until(enough)
        self.press("Pause")
        until(lambda: not self.server.running)


def until(true: Callable[[], bool], seconds: float = 30.0):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.fixture(scope="module")
def visitor(browser, viewer):
    return Visitor(browser, viewer)


def test_a_slider_that_a_mouse_moves_bends_the_arm_that_is_seen(visitor):
    session = visitor.server.session
    before, again = visitor.picture(), visitor.picture()
    np.testing.assert_array_equal(before, again)
    visitor.drag("Bend 0° [W]", 0.9)
    assert session.core.record.power[0, 0] == 0.0
    visitor.run(lambda: session.core.record.tip[0, 0, 3] > 10e-3)
    assert session.command == pytest.approx([1.8, 0.0, 0.0], abs=0.1) and session.core.record.temperature[0, 0] > 60.0
    moved = np.abs(visitor.picture() - before).max(axis=-1) > 40
    assert 0.05 < moved.mean() < 0.5
    for name, part in session.parts().items():  # it is not only coloured
        assert meshes(visitor)[f"reach/{name}"][0].vertices == pytest.approx(100.0 * part.vertices, abs=1e-4), name  # in cm
    told = visitor.page.locator('[data-reading="time"]').inner_text()
    assert abs(float(told.removesuffix(" s")) - session.time) < 0.25


def test_a_single_step_is_a_tenth_of_a_second(visitor):
    began = visitor.server.session.time
    visitor.press("Step by 0.1 s")
    until(lambda: visitor.server.session.time > began)
    assert visitor.server.session.time == pytest.approx(began + 0.1)


def test_keys_move_the_world_a_button_changes_the_task_and_reset_begins_again(visitor):
    thumb = visitor.slider("Gravity [g]").get_by_role("slider")
    thumb.focus()
    thumb.press("Home")
    visitor.run(lambda: visitor.server.session.core.load[8] == pytest.approx(-9.81))
    visitor.press("PickAndPlace")
    until(lambda: visitor.server.session.task == "pick-and-place")
    visitor.page.get_by_text("Stage [mm]").wait_for()
    session = visitor.server.session
    visitor.press("Step by 0.1 s")
    until(lambda: session.time > 0.0)
    assert session.world.gravity == -1.0  # as the slider stands
    visitor.press("Reset")
    until(lambda: session.time == 0.0)


def test_every_task_shows_its_own_meshes(visitor):
    for task in ("Reach", "TwistAlign", "PickAndPlace", "Reach"):
        visitor.press(task)
        name = {"Reach": "reach", "TwistAlign": "twist-align", "PickAndPlace": "pick-and-place"}[task]
        until(lambda name=name: visitor.server.session.task == name and all(key.startswith(name) for key in meshes(visitor)))
        shown = visitor.server.session.parts()
        assert {f"{name}/{key}" for key in shown} == set(meshes(visitor))
        for key, part in shown.items():
            handle = meshes(visitor)[f"{name}/{key}"][0]
            assert handle.opacity == (None if part.opacity == 1.0 else part.opacity), key
            assert len(handle.vertices) == len(part.vertices)


def meshes(visitor):
    return dict(visitor.server._meshes)


def test_who_types_beyond_a_range_is_kept_in_it(visitor):
    page, session = visitor.page, visitor.server.session
    beside = visitor.slider("Payload [g]").locator("xpath=following-sibling::*//input")
    visitor.press("Run")
    beside.fill("50")
    until(lambda: visitor.server.session.world.payload == 5.0)
    beside.fill("0")
    page.get_by_label("Seed").first.fill("-5")
    visitor.press("Reset")
    until(lambda: visitor.server.session.seed == 0)
    visitor.press("Pause")
    until(lambda: not visitor.server.running)
    assert page.get_by_text("This page has stopped").count() == 0 and visitor.server.session is session


def test_the_scripted_controller_drives_and_its_sliders_show_it(visitor):
    visitor.page.get_by_role("button", name="scripted").click()
    until(lambda: visitor.server.session.controller == "scripted")
    session = visitor.server.session
    visitor.run(lambda: session.time >= 0.6 and session.core.record.power[0].any())
    beside = visitor.slider("Bend 0° [W]").locator("xpath=following-sibling::*//input")  # no thumb: it cannot be moved now
    assert float(beside.input_value()) > 0.0


def test_visitors_do_not_disturb_one_another(browser, viewer, visitor, monkeypatch):
    visitor.press("PickAndPlace")
    until(lambda: visitor.server.session.task == "pick-and-place" and visitor.server.session.time == 0.0)
    other = Visitor(browser, viewer)
    assert other.server.session.task == "reach" and visitor.server.session.task == "pick-and-place"
    other.run(lambda: other.server.session.time > 0.5)
    assert visitor.server.session.time == 0.0
    # One whose environment fails is told so, and keeps it to himself.
    monkeypatch.setattr(visitor.server.session, "step", lambda: 1 / 0)
    visitor.press("Step by 0.1 s")
    visitor.page.get_by_text("This page has stopped").wait_for()
    assert viewer.pages == {other.number: other.server}
    stepped = other.server.session.time
    other.press("Step by 0.1 s")
    until(lambda: other.server.session.time > stepped)
    other.context.close()
    until(lambda: not viewer.pages)
    until(lambda: not any(thread.name.startswith("visitor") for thread in threading.enumerate()))
    assert not other.errors


def test_no_visitor_can_open_a_tunnel(visitor, viewer, monkeypatch):
    asked = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *where: asked.append(where) or 1 / 0)
    assert viewer.server.request_share_url() is None and not asked


def test_nothing_comes_from_elsewhere_and_the_console_is_quiet(visitor):
    assert not visitor.errors
    assert len(visitor.requests) > 1
    assert all(
        url.removeprefix("blob:").startswith(("data:", "http://127.0.0.1:", "ws://127.0.0.1:")) for url in visitor.requests
    )
