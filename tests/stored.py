"""What is made once a test session, for all its processes."""

from __future__ import annotations

import fcntl
import hashlib
import os
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeVar, cast

from sst_graph.simulator import SimulatedDrive, SimulationConfig, simulate, write_drive
from sst_graph.types import CameraImage, Frame, Scan

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
    """A simulated drive whose frames are :func:`stored`."""

    def read_scan(self, position: int) -> Scan:
        scan = self[position].scan
        assert scan is not None
        return scan

    def read_image(self, position: int) -> CameraImage:
        if simulated(self.config) is not self:
            return super().read_image(position)
        image = self[position].image
        assert image is not None
        return image

    def __getitem__(self, position: int) -> Frame:
        if simulated(self.config) is not self:  # changed since: a drive of its own
            return super().__getitem__(position)
        index = self._checked(position)
        return stored((self.config, index), lambda: super(StoredDrive, self).__getitem__(index))


@cache
def simulated(config: SimulationConfig) -> StoredDrive:
    """As :func:`sst_graph.simulator.simulate`, but each frame is rendered once a session."""
    return StoredDrive(**vars(simulate(config)))


def written(config: SimulationConfig) -> Path:
    """Folder ``street`` of a simulated drive, written once a session; for reading only."""
    folder = Path(os.environ[FOLDER], _name(config) + "-written", "street")
    with open(folder.parent.with_suffix(".lock"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            write_drive(simulate(config), folder)
    return folder
