"""The one list of tasks: an entry names all that belongs to a task, and registering it registers its Gymnasium ids.

A task of a user is registered the same way, by the user's module: `register(Entry("push", "MyPush", Push, my_robot))`. From
then on `gymnasium.make("MyPush-v0")`, the viewer and `train.py --task my_module:push` know it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import gymnasium


@dataclass(frozen=True)
class Entry:
    """All that belongs to a task.

    A field that says "reference" holds the object itself or where it is, as "module:attribute": `load` imports it when it is
    asked for, so that an entry can name what lies above the tasks, such as a controller.

    Parameters
    ----------
    name : str
        By which `registry.entry`, `train.py` and the viewer know the task.
    id : str
        Of the environments: "TCAReach" stands for "TCAReach-v0" (sparse) and "TCAReachDense-v0" (dense rewards).
    task : reference to a subclass of `tasks.task.Task`
        Its docstring is the documentation page.
    robot : reference to a `robots.Robot`
        What the task moves unless it is given another.
    steps : int
        Of an episode.
    controller : reference to a function without arguments, optional
        Returns a controller that solves the task.
    fastest : reference to a function, optional
        Of the first observation of an episode: the least time [s] in which the heaters can succeed.
    features : reference to a function, optional
        Of observations as tensors (N, ...): what a network is shown of them (N, k).
    settings : reference to a function, optional
        Of this entry: the settings of training by algorithm.
    algorithm : str, optional
        The one that training takes by default.
    camera : str or pair of (3,) tuples, optional
        From where the task is drawn by default, see `ArmEnv`.
    scene : reference to a function, optional
        Of a number of cases: the scene of the study.
    page : str, optional
        Path of the documentation page under docs/.
    """

    name: str
    id: str
    task: Any
    robot: Any
    steps: int = 100
    controller: str | Callable[[], Any] | None = None
    fastest: str | Callable[[Any], float] | None = None
    features: str | Callable[[Any], Any] | None = None
    settings: str | Callable[["Entry"], Any] | None = None
    algorithm: str | None = None
    camera: Any = None
    scene: str | Callable[[int], Any] | None = None
    page: str | None = None

    @property
    def ids(self) -> dict[str, str]:
        """The ids of the environments by reward, "sparse" and "dense"."""
        return {"sparse": f"{self.id}-v0", "dense": f"{self.id}Dense-v0"}

    def new(self, robot: Any = None, **arguments: Any) -> Any:
        """Return the task with a robot, by default the entry's, and with the other arguments of its class."""
        return load(self.task)(load(self.robot) if robot is None else robot, **arguments)

    @property
    def title(self) -> str:
        """Name of the task's class, for headings."""
        return str(load(self.task).__name__)


_ENTRIES: dict[str, Entry] = {}


def register(entry: Entry) -> None:
    """Make a task known by its name, and its environments to Gymnasium by their ids.

    Raises
    ------
    ValueError
        If another task has that name or id.
    """
    for other in _ENTRIES.values():
        if other != entry and (other.name == entry.name or other.id == entry.id):
            raise ValueError(f"entry = {entry.name!r} with the id {entry.id!r}: expected neither to be taken, as by {other!r}")
    if entry.name in _ENTRIES:
        return
    _ENTRIES[entry.name] = entry
    for reward, name in entry.ids.items():
        gymnasium.register(
            id=name,
            entry_point="tca_envs.env:ArmEnv",
            vector_entry_point="tca_envs.vector:ArmVectorEnv",
            max_episode_steps=entry.steps,
            kwargs={"task": entry.name, "reward": reward} | ({} if entry.camera is None else {"camera": entry.camera}),
        )


def entries() -> tuple[Entry, ...]:
    """Return the entries of all tasks in the order in which they were registered."""
    return tuple(_ENTRIES.values())


def entry(name: str) -> Entry:
    """Return the entry of a task.

    Parameters
    ----------
    name : str
        The task's, or "module:name": then the module is imported first, which registers its tasks.

    Raises
    ------
    ValueError
        If there is no task of that name.
    """
    module, _, task = name.rpartition(":") if isinstance(name, str) else ("", "", name)
    if module:
        import_module(module)
    if not isinstance(task, str) or task not in _ENTRIES:
        raise ValueError(f"task = {name!r}: expected one of {', '.join(map(repr, _ENTRIES))}, or 'module:name'")
    return _ENTRIES[task]


def load(reference: Any) -> Any:
    """Return what a reference "module:attribute" names; anything but a string is returned as it is.

    Raises
    ------
    ModuleNotFoundError
        If its package is not there: `agents` and `study` are in a checkout of the repository only.
    """
    if not isinstance(reference, str):
        return reference
    module, _, attribute = reference.partition(":")
    package = module.partition(".")[0]
    try:
        return getattr(import_module(module), attribute)
    except ModuleNotFoundError as error:
        if error.name not in (package, module):
            raise
        raise ModuleNotFoundError(
            f"{reference} needs the package {package!r}, which a checkout of the repository has"
        ) from error
