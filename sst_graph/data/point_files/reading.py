"""Which reader a cloud's file needs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from sst_graph.data.point_files.arrays import read_bin, read_npy, read_npz
from sst_graph.data.point_files.cloud import CLOUD_FILE, PointFields
from sst_graph.data.point_files.pcd import read_pcd
from sst_graph.data.point_files.ply import read_ply
from sst_graph.errors import DataError
from sst_graph.files.reading import read_file

_READERS: Mapping[str, Callable[[bytes, Path], PointFields]] = {
    ".bin": read_bin,
    ".npy": read_npy,
    ".npz": read_npz,
    ".pcd": read_pcd,
    ".ply": read_ply,
}
SUFFIXES = tuple(_READERS)


def read_cloud(path: Path) -> PointFields:
    """The cloud in a .bin (x y z intensity in float32), .npy, .npz, .pcd or .ply file.

    Raises:
        DataError: a missing file, one of another kind, truncated or damaged, or without x, y, z.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise DataError(path, f"the ending {path.suffix!r:.20}", f"one of {', '.join(SUFFIXES)}")
    return reader(read_file(path, CLOUD_FILE), path)
