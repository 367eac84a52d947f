"""What several tests need."""

import importlib
import subprocess
import sys

import gymnasium
import pytest

from tca_envs import registry


@pytest.fixture
def toy():
    """The module toy.py, a user's robot and task, known to the registry for a test."""
    yield importlib.import_module("toy")
    for name in registry._ENTRIES.pop("turn").ids.values():
        gymnasium.registry.pop(name)
    del sys.modules["toy"]


@pytest.fixture(scope="session")
def drawing():
    """Skip without PyVista and some OpenGL, which crashes VTK when it is missing; so another process looks."""
    pytest.importorskip("pyvista", reason='PyVista is missing: pip install -e ".[render]"')
    code = "import gymnasium, tca_envs; e = gymnasium.make('TCAReach-v0', render_mode='rgb_array'); e.reset(); e.render()"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    if "no OpenGL" in found.stderr:
        pytest.skip("no OpenGL: neither a display nor EGL nor OSMesa")
    assert found.returncode == 0, found.stderr
