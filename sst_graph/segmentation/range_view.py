"""Scans as range images, as lidar-bonnetal's networks take them, and labels back to the points.

Source: A. Milioto, I. Vizzo, J. Behley, C. Stachniss, "RangeNet++", IROS 2019; PRBonn/lidar-bonnetal
(laserscan.py: projection, KNN.py: labels of points). Two things are otherwise here: pixels beyond the border
of the image are no neighbours, and a point all of whose neighbours are unlabelled may be anything (there: the
first class).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sst_graph.types import Scan, intensities_of

CHANNELS = 5
"""Range, x, y, z [m], remission."""


@dataclass(frozen=True)
class Neighbours:
    """How labels of pixels are given to points, by the nearest in range of the pixels around.

    Attributes:
        count: neighbours that vote.
        window: width of the square in which they are looked for [px], odd.
        sigma_px: of the Gaussian by which pixels near the centre count as nearer.
        cutoff_m: weighted difference of range beyond which a neighbour has no vote [m]; 0: all vote.
    """

    count: int = 5
    window: int = 5
    sigma_px: float = 1.0
    cutoff_m: float = 1.0


@dataclass(frozen=True)
class RangeView:
    """Geometry and scale of a network's range images.

    Attributes:
        width, height: of the image [px].
        fov_up_deg, fov_down_deg: elevation of the upper and of the lower border [deg].
        mean, std: of range, x, y, z and remission, which are normalized by them.
        remission_range: remission of the data that counts as 1.
    """

    width: int = 2048
    height: int = 64
    fov_up_deg: float = 3.0
    fov_down_deg: float = -25.0
    mean: tuple[float, ...] = (12.12, 10.88, 0.23, -1.04, 0.21)
    std: tuple[float, ...] = (12.32, 11.47, 6.91, 0.86, 0.16)
    remission_range: float = 1.0

    def project(self, scan: Scan) -> RangeImage:
        """The range image of a scan; the nearest of several points has the pixel.

        Without intensities the remission is the mean: networks see nothing unusual in it.
        """
        points = scan.points.astype(np.float64)
        ranges = np.maximum(np.linalg.norm(points, axis=1), 1e-7)
        yaw = -np.arctan2(points[:, 1], points[:, 0])
        pitch = np.arcsin(np.clip(points[:, 2] / ranges, -1.0, 1.0))
        up, down = np.radians(self.fov_up_deg), np.radians(self.fov_down_deg)
        columns = np.floor(0.5 * (yaw / np.pi + 1.0) * self.width)
        rows = np.floor((1.0 - (pitch - down) / (up - down)) * self.height)
        columns = np.clip(columns, 0, self.width - 1).astype(np.intp)
        rows = np.clip(rows, 0, self.height - 1).astype(np.intp)
        order = np.argsort(-ranges, kind="stable")
        point = np.full((self.height, self.width), -1, np.int64)
        point[rows[order], columns[order]] = order
        intensities = intensities_of(scan)
        if intensities is None:
            remission = np.full(len(points), self.mean[4])
        else:
            remission = np.nan_to_num(intensities.astype(np.float64)) / self.remission_range
        features = np.column_stack([ranges, points, remission])
        normal = ((features - self.mean) / self.std).astype(np.float32)
        values = np.zeros((CHANNELS, self.height, self.width), np.float32)
        seen = point >= 0
        values[:, seen] = normal[point[seen]].T
        return RangeImage(values[None], point, rows, columns, ranges.astype(np.float32))


@dataclass(frozen=True, eq=False)
class RangeImage:
    """A scan as a range image.

    Attributes:
        values: (1, 5, h, w) float32 normalized input of the network; 0 where there is no point.
        point: (h, w) index of the point in each pixel, -1 where there is none.
        rows, columns: (n,) pixel of each point.
        ranges: (n,) float32 [m].
    """

    values: NDArray[np.float32]
    point: NDArray[np.int64]
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    ranges: NDArray[np.float32]

    def of_points(
        self, numbers: NDArray[np.intp], neighbours: Neighbours | None, unlabelled: NDArray[np.bool_]
    ) -> NDArray[np.intp]:
        """Numbers (n,) of the points by those of the pixels (h, w).

        Args:
            neighbours: None: each point takes the number of its pixel.
            unlabelled: (c,) numbers that have no vote.

        Returns:
            -1 where no neighbour votes.
        """
        own = numbers[self.rows, self.columns]
        if neighbours is None:
            return np.asarray(own)
        half = neighbours.window // 2
        ranges = np.where(self.point >= 0, self.ranges[self.point], np.inf).astype(np.float32)
        ranges = np.pad(ranges, half, constant_values=np.inf)
        padded = np.pad(numbers, half)
        down, right = np.mgrid[: neighbours.window, : neighbours.window].reshape(2, -1)
        rows, columns = self.rows[:, None] + down, self.columns[:, None] + right
        around = ranges[rows, columns]
        around[:, len(down) // 2] = self.ranges  # the point itself, also where another has its pixel
        far = np.abs(around - self.ranges[:, None]) * _nearness(neighbours)
        count = min(neighbours.count, far.shape[1])
        nearest = np.argpartition(far, count - 1, axis=1)[:, :count]
        votes = np.take_along_axis(padded[rows, columns], nearest, axis=1)
        distance = np.take_along_axis(far, nearest, axis=1)
        silent = unlabelled[votes] | ~np.isfinite(distance)
        if neighbours.cutoff_m > 0.0:
            silent |= distance > neighbours.cutoff_m
        classes = len(unlabelled)
        slots = np.where(silent, classes, votes) + (classes + 1) * np.arange(len(votes))[:, None]
        counts = np.bincount(slots.ravel(), minlength=(classes + 1) * len(votes)).reshape(-1, classes + 1)
        counts = counts[:, :classes]
        return np.where(counts.any(axis=1), counts.argmax(axis=1), -1)


def _nearness(neighbours: Neighbours) -> NDArray[np.float32]:
    """(window * window,) factor of a difference in range, smallest for the centre: 1 - Gaussian of sum 1."""
    steps = np.arange(neighbours.window) - neighbours.window // 2
    bell = np.exp(-(steps[:, None] ** 2 + steps[None, :] ** 2) / (2.0 * neighbours.sigma_px**2))
    return np.asarray((1.0 - bell / bell.sum()).ravel(), np.float32)
