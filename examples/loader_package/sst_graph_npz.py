"""Drives of 000000.npz, ...: each with stamp_ns, points (n, 3), pixels (h, w, 3) and K (3, 3)."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sst_graph.data import Loader, SourceOptions
from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import CameraImage, Frame, Scan, SemanticClass


@dataclass(frozen=True)
class NpzDrive:
    name: str
    camera: PinholeCamera
    files: list[Path]
    nominal = truth = None

    def __len__(self):
        return len(self.files)

    def __getitem__(self, position):
        if isinstance(position, slice):
            return NpzDrive(self.name, self.camera, self.files[position])
        data = np.load(self.files[position])
        points, pixels, stamp_ns = data["points"], data["pixels"], int(data["stamp_ns"])
        classes, mask = (np.full(n, SemanticClass.IGNORE, np.uint8) for n in (len(points), pixels.shape[:2]))
        scan, image = Scan(stamp_ns, points, classes), CameraImage(stamp_ns, mask, pixels)
        return Frame(int(self.files[position].stem), scan, image)

    def __iter__(self):
        return (self[position] for position in range(len(self)))


def open_npz(path: Path, options: SourceOptions) -> NpzDrive:
    files = sorted(path.glob("*.npz"))
    first = np.load(files[0])
    K, (height, width) = first["K"], first["pixels"].shape[:2]
    camera = PinholeCamera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], width, height)
    return NpzDrive(path.name, camera, files)[options.frames or slice(None)]


LOADER = Loader(lambda path: any(path.glob("*.npz")), open_npz, "PATH/000000.npz, ...")
