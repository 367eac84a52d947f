"""How functions are compiled, and where compiled code is kept.

Numba's own cache watches the one file that a function is in and stops the program where it cannot write. This one is stamped by
a digest of all of the package's sources, and whatever goes wrong with a file (no folder, no space, no permission, half a file,
somebody else's) is a miss: the function is compiled again.
"""

import hashlib
import marshal
import os
import pickle
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba import config, njit, types
from numba.core.caching import NullCache
from numba.core.ccallback import CFunc
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps
from numba.core.sigutils import normalize_signature
from numba.core.typing.templates import infer_global
from numba.misc.appdirs import AppDirs

from tca_envs.mechanics.solver.simd import LANES

# Not nnan or ninf: overflow must stay visible.
OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz", "arcp"}}
PACKAGE = Path(__file__).parents[2]
"""Whose sources the compiled code depends on."""


_KEPT: list[Any] = []
"""Compiled code lives as long as these do."""


def part(function: Any, **options: Any) -> Any:
    """Let compiled functions call a function, which is compiled once for all of them; in Python it stays what it is."""
    if not config.DISABLE_JIT:
        made = njit(function, no_cpython_wrapper=True, no_cfunc_wrapper=True, **OPTIONS, **options)
        _KEPT.append(made)
        infer_global(function, types.Dispatcher(made))
    return function


def compiled(function: Any, **options: Any) -> Any:
    """Return a function that is compiled, or read from the cache, when it is first called; without the GIL."""
    made = njit(function, nogil=True, **{**OPTIONS, **options})
    if not config.DISABLE_JIT and function.__closure__ is None:
        made._cache = Cache(function, options)
    return made


def address_of_kernel(function: Callable[..., Any], kind: Any) -> int:
    """Compile a function of signature `kind` (or read it from the cache) for callers that know its address, and return that."""
    args, result = normalize_signature(kind)
    made: Any = CFunc(function, (args, result), locals={}, options=OPTIONS)
    made._cache = Cache(function, {})
    made.compile()
    _KEPT.append(made)
    return int(made.address)


class Cache(NullCache):
    """Where Numba looks for the compiled code of a function, and puts it."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self.name = function.__qualname__.replace("<", "").replace(">", "")
        self.path = Path(function.__code__.co_filename)
        top = sys.modules.get(function.__module__.partition(".")[0])
        own = Path(top.__path__[0]) if top is not None and hasattr(top, "__path__") else self.path
        # Now, not when it compiles: what is edited in between is not what has been imported.
        text = (marshal.dumps(function.__code__, 2), function.__defaults__, sorted(options.items()))
        self.sources = _digest(repr((_sources(PACKAGE), _sources(own), text)).encode())[:16]

    def names(self, sig: Any, target: Any) -> tuple[str, str]:
        """Return how names of files begin for this function, argument types and machine, and the name for these sources."""
        machine = (sys.version, numba.__version__, llvmlite.__version__, LANES, target.codegen().magic_tuple())
        begin = f"{self.name}-{_digest(repr((str(self.path), str(sig), machine)).encode())[:16]}-"
        return begin, f"{begin}{self.sources}.nbc"

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return compiled code, None if there is none."""
        target_context.refresh()
        _, name = self.names(sig, target_context)
        for folder in folders():
            try:
                content = (folder / name).read_bytes()
                if content[:64] == _digest(content[64:]).encode():
                    return CompileResult._rebuild(target_context, *pickle.loads(content[64:]))
            except Exception:
                continue
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep compiled code where that is possible, in place of that of other sources."""
        if data.library.has_dynamic_globals:  # such as addresses, which are another process's then
            return
        with suppress(Exception):
            content = dumps(data._reduce())
            content = _digest(content).encode() + content
            begin, name = self.names(sig, data.target_context)
            for folder in folders():
                if _written(folder / name, content):
                    _clear(folder, begin, name)
                    return


def folders() -> list[Path]:
    """Return where compiled code is looked for, and kept in the first that can be written into."""
    own = [Path(__file__).parent / "__pycache__", Path(AppDirs(appname="tca_envs", appauthor=False).user_cache_dir)]
    return [Path(config.CACHE_DIR) / "tca_envs"] if config.CACHE_DIR else own


@cache
def _sources(root: Path) -> str:
    """Return a digest of all sources in a folder, or of one."""
    paths = sorted(root.rglob("*.py")) if root.is_dir() else [root]
    return _digest(b"".join(str(path.relative_to(root)).encode() + b"\n" + _read(path) for path in paths))


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""


def _written(path: Path, content: bytes) -> bool:
    """Write a file aside and rename it, so that nobody reads half of it; return whether that worked."""
    aside = path.with_suffix(f".{os.getpid()}.nbc")  # what a killed process leaves goes with the next `_clear`
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        aside.write_bytes(content)
        os.replace(aside, path)
        return True
    except OSError:
        with suppress(OSError):
            aside.unlink()
        return False


def _clear(folder: Path, begin: str, but: str) -> None:
    """Remove the files of a function that other sources made."""
    for path in folder.glob(f"{begin}*.nbc"):
        if path.name != but:
            with suppress(OSError):
                path.unlink()
