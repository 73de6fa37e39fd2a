"""Drives of 000000.npz, ...: each with stamp_ns, points (n, 3), pixels (h, w, 3) and K (3, 3); no labels."""

import numpy as np

from sst_graph.data import DriveProperties, Loader, Sensor, merged
from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import CameraImage, Scan, SemanticClass


def open_npz(path, options):
    files = sorted(path.glob("*.npz"))
    stamps, pixels = np.array([np.load(file)["stamp_ns"] for file in files]), np.load(files[0])["pixels"]
    (height, width), K = pixels.shape[:2], np.load(files[0])["K"]
    camera = PinholeCamera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], width, height)
    mask = np.full((height, width), SemanticClass.IGNORE, np.uint8)

    def scan(k):
        points = np.load(files[k])["points"]
        return Scan(stamps[k], points, np.full(len(points), SemanticClass.IGNORE, np.uint8))

    images = Sensor(stamps, lambda k: CameraImage(stamps[k], mask, np.load(files[k])["pixels"]))
    return merged(DriveProperties(path.name, camera), Sensor(stamps, scan), images, options, path)


LOADER = Loader(lambda path: any(path.glob("*.npz")), open_npz, "PATH/000000.npz, ...")
