"""What is made once a test session, for all its processes."""

from __future__ import annotations

import fcntl
import hashlib
import os
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, cast

from sst_graph.simulator import SimulatedDrive, SimulationConfig, simulate, write_drive
from sst_graph.simulator.street import build_street

FOLDER = "SST_GRAPH_TEST_FOLDER"
"""Environment variable: folder of the session, made by conftest.py before the workers start."""
T = TypeVar("T")


def stored(key: object, make: Callable[[], T]) -> T:
    """What ``make`` gives, made by the first that asks in a session and read from disk by all others.

    Args:
        key: says all that the result depends on, by its ``repr``.
        make: its result must pickle.
    """
    folder = os.environ.get(FOLDER)
    if folder is None:  # outside pytest
        return make()
    path = Path(folder, _name(key))
    with open(path, "a+b") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.seek(0)
        content = file.read()
        if content:
            return cast(T, pickle.loads(content))
        result = make()
        file.write(pickle.dumps(result, pickle.HIGHEST_PROTOCOL))
        return result


def _name(key: object) -> str:
    return hashlib.sha256(repr(key).encode()).hexdigest()


@dataclass(frozen=True)
class StoredDrive(SimulatedDrive):
    """A simulated drive whose scans and images are :func:`stored`, however they are asked for.

    Its street is built when it is asked for: what is stored needs none.
    """

    def __getattr__(self, name: str) -> Any:
        if name != "street":
            raise AttributeError(name)
        object.__setattr__(self, name, build_street(self.config))
        return self.street

    def _scan(self, index: int) -> Any:
        make = partial(super()._scan, index)
        return stored((self.config, "scan", index), make) if self is _DRIVES.get(self.config) else make()

    def _image(self, index: int) -> Any:
        make = partial(super()._image, index)
        return stored((self.config, "image", index), make) if self is _DRIVES.get(self.config) else make()


_DRIVES: dict[SimulationConfig, StoredDrive] = {}
"""Of this process; one that was changed since is a drive of its own, and is not stored."""


def simulated(config: SimulationConfig) -> StoredDrive:
    """As :func:`sst_graph.simulator.simulate`, but each scan and image is rendered once a session."""
    if config not in _DRIVES:
        drive = _DRIVES[config] = object.__new__(StoredDrive)
        built: dict[str, Any] = {}

        def make() -> dict[str, Any]:
            built.update(vars(simulate(config)))
            return {name: value for name, value in built.items() if name != "street"}

        vars(drive).update(stored((config, "drive"), make) | built)
    return _DRIVES[config]


def written(config: SimulationConfig) -> Path:
    """Folder ``street`` of a simulated drive, written once a session; for reading only."""
    folder = Path(os.environ[FOLDER], _name(config) + "-written", "street")
    with open(folder.parent.with_suffix(".lock"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            write_drive(simulated(config), folder)
    return folder
