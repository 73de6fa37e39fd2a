"""The drives of a table: simulated streets, or what the user gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sst_graph.data import open_source
from sst_graph.errors import ConfigError
from sst_graph.experiments.paper.config import VARIANTS, PaperTableConfig
from sst_graph.experiments.starts import expect_labels
from sst_graph.simulator import simulate
from sst_graph.types import Source

_KITTI_00 = "00"


@dataclass(frozen=True)
class TableDrive:
    """A drive that is opened where it is used, so that it can be sent to another process.

    Attributes:
        name: for people.
        street: number of a simulated street, or None.
        path, sequence, frames: of data on disk.
        seed: of its starts.
    """

    name: str
    street: int | None = None
    path: str = ""
    sequence: str | None = None
    frames: str | None = None
    seed: int = 0

    def open(self, config: PaperTableConfig, images_late: int) -> Source:
        """The drive with images that many frames late.

        Raises:
            ConfigError, DataError: it cannot be read so.
        """
        if self.street is not None:
            return simulate(config.street(self.street, images_late))
        return open_source(self.path, sequence=self.sequence, frames=self.frames, image_shift=images_late)


def table_drives(config: PaperTableConfig) -> Sequence[TableDrive]:
    """All drives of a table.

    Raises:
        ConfigError: two drives of one name, or one without a reference calibration.
        DataError: a drive that cannot be opened, or without the labels that a method needs.
    """
    if not config.data:
        return [
            TableDrive(f"street {config.seed + k}", street=k, seed=config.seed + k)
            for k in range(config.streets)
        ]
    drives = [_on_disk(path, config) for path in config.data]
    names = [drive.name for drive in drives]
    if len(set(names)) < len(names):
        raise ConfigError(f"data: found drives named {', '.join(names)}, expected names that differ")
    return drives


def _on_disk(path: str, config: PaperTableConfig) -> TableDrive:
    """The drive at a path: of a KITTI odometry root the sequence 00, of that the paper's stretch."""
    sequence = _KITTI_00 if Path(path, "sequences", _KITTI_00).is_dir() else None
    source = open_source(path, sequence=sequence)
    if source.truth is None:
        raise ConfigError(
            f"{path}: found no reference calibration, expected one (calib.txt, groundtruth.json)"
        )
    first, end = config.kitti_frames
    frames, name = None, source.name
    if name.endswith(f"/{_KITTI_00}") and len(source) >= end:
        frames, name = f"{first}:{end}", f"{name}, frames {first} to {end - 1}"
    drive = TableDrive(name, None, path, sequence, frames, config.seed)
    expect_labels(drive.open(config, 0), (VARIANTS[method].method for method in config.methods))
    return drive
