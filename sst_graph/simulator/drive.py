"""A simulated drive as a source of frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.factors.camera import PinholeCamera
from sst_graph.simulator.camera.render import CameraView, Look, developed, shade
from sst_graph.simulator.camera.segmentation import noisy_mask, noisy_points
from sst_graph.simulator.camera.textures import Atlas, detail_atlas, material_atlas, sky_panorama
from sst_graph.simulator.casting import cast_image
from sst_graph.simulator.config import SimulationConfig
from sst_graph.simulator.lidar import Lidar, make_lidar
from sst_graph.simulator.street import Street, build_street, is_instance
from sst_graph.simulator.surfaces import SEMANTIC_CLASS, FaceKind
from sst_graph.types import CameraImage, FloatArray, Frame, GroundTruth, Scan
from sst_graph.validation import checked_position

VIEW_RANGE_M = 140.0
"""Static things farther than this are not in the picture [m]."""
LIDAR_MARGIN_M = 5.0

KITTI_FOCAL_PX, KITTI_WIDTH_PX = 721.5377, 1242
KITTI_CENTRE = (609.5593 / 1242.0, 172.854 / 375.0)
NOMINAL_CTL = gtsam.Pose3(
    gtsam.Rot3.ClosestTo(
        np.array(
            [
                [2.347736981e-04, -9.999441545e-01, -1.056347781e-02],
                [1.044940741e-02, 1.056535364e-02, -9.998895741e-01],
                [9.999453885e-01, 1.243653784e-04, 1.045130299e-02],
            ]
        )
    ),
    np.array([0.05737, -0.07536, -0.26939]),
)
"""Pose of KITTI's LiDAR (2011_09_26) in its left colour camera as published: the nominal extrinsic."""


@dataclass(frozen=True)
class RawFrame:
    """A scan and an image in the simulator's own kinds, noise included.

    Attributes:
        points: (n, 3) float32 [m]; offsets_s (n,) float32 [s]; rings (n,) uint16 from the top.
        point_kinds, point_instances: (n,) labels of the points.
        pixels: (h, w, 3) uint8; pixel_kinds (h, w) uint8.
    """

    points: NDArray[np.float32]
    offsets_s: NDArray[np.float32]
    rings: NDArray[np.uint16]
    point_kinds: NDArray[np.uint8]
    point_instances: NDArray[np.uint16]
    pixels: NDArray[np.uint8]
    pixel_kinds: NDArray[np.uint8]


@dataclass(frozen=True)
class SimulatedDrive:
    """A drive through a simulated street (satisfies :class:`sst_graph.types.Source`).

    Frames are made when asked for, in any order, the same ones each time.

    Attributes:
        config: what was asked for.
        camera: intrinsics.
        nominal: the extrinsic that the data claims.
        truth: the true extrinsic and time offset.
        street: the world; ``street.ego`` is the LiDAR's true motion.
        stamps_ns: (n,) stamp of each scan, and in its own clock of each image [ns].
        camera_number: of several cameras of one vehicle; noise and mistakes differ by it.
    """

    config: SimulationConfig
    camera: PinholeCamera
    nominal: gtsam.Pose3
    truth: GroundTruth
    street: Street
    stamps_ns: NDArray[np.int64]
    camera_number: int = 0

    @property
    def name(self) -> str:
        """Name of the drive: motion and seed."""
        return f"simulated-{self.config.motion}-{self.config.seed}"

    @property
    def sweep(self) -> str:
        """What the drive knows about its sweep: that the whole scan is taken at once, or nothing."""
        return "auto" if self.config.rolling else "known"

    @property
    def lidar(self) -> Lidar:
        """The sensor."""
        return make_lidar(self.config)

    @property
    def look(self) -> Look:
        """What the street is painted with; drawn when the first picture is asked for."""
        return Look(*_textures(self.config.seed), self.street.sun, self.street.sunlight)

    def __len__(self) -> int:
        return self.config.frames

    def __iter__(self) -> Iterator[Frame]:
        for position in range(len(self)):
            yield self[position]

    def __getitem__(self, position: int) -> Frame:
        """Frame at ``position``; negative positions count from the end.

        Raises:
            DataError: no whole number.
            IndexError: beyond the drive.
        """
        index = self._checked(position)
        return Frame(index, self.scan(index), self.image(index))

    def image(self, position: int) -> CameraImage:
        """The picture of a frame, without its scan."""
        index = self._checked(position)
        pixels, kinds, instances = self._image(index)
        return CameraImage(int(self.stamps_ns[index]), SEMANTIC_CLASS[kinds], pixels, instances)

    def scan(self, position: int) -> Scan:
        """The scan of a frame, without its picture."""
        index = self._checked(position)
        points, offsets, rings, kinds, instances = self._scan(index)
        times = offsets if self.config.gives_times else None
        return Scan(int(self.stamps_ns[index]), points, SEMANTIC_CLASS[kinds], instances, times, rings)

    def frame_number(self, position: int) -> int:
        """Index of the frame at a position."""
        return self._checked(position)

    def read_scan(self, position: int) -> Scan:
        """As :meth:`scan`."""
        return self.scan(position)

    def read_image(self, position: int) -> CameraImage:
        """As :meth:`image`."""
        return self.image(position)

    def raw(self, position: int) -> RawFrame:
        """The frame in the simulator's own kinds."""
        index = self._checked(position)
        points, offsets, rings, kinds, instances = self._scan(index)
        pixels, pixel_kinds, _ = self._image(index)
        return RawFrame(points, offsets, rings, kinds, instances, pixels, pixel_kinds)

    def wTl(self, lidar_time_s: float) -> gtsam.Pose3:
        """True pose of the LiDAR in the world at a LiDAR time [s]."""
        rotation, position = self.street.ego.pose(np.array([lidar_time_s]))
        return gtsam.Pose3(gtsam.Rot3(rotation[0]), position[0])

    def wTc(self, camera_stamp_s: float) -> gtsam.Pose3:
        """True pose of the camera in the world when it stamps ``camera_stamp_s`` [s]."""
        return self.wTl(camera_stamp_s + self.config.time_offset_s) * self.truth.cTl.inverse()

    def _checked(self, position: int) -> int:
        return checked_position(position, len(self))

    def _scan(
        self, index: int
    ) -> tuple[
        NDArray[np.float32], NDArray[np.float32], NDArray[np.uint16], NDArray[np.uint8], NDArray[np.uint16]
    ]:
        """Points, times, rings and labels of scan ``index``."""
        config, stamp_s = self.config, self.stamps_ns[index] * 1e-9
        snapshot = self.street.snapshot(stamp_s, config.max_range_m + LIDAR_MARGIN_M)
        rng = np.random.default_rng([config.seed, 40, index])
        returns = self.lidar.scan(snapshot, self.street.ego, stamp_s, rng)
        kinds = snapshot.mesh.kinds[returns.faces]
        instances = np.where(is_instance(kinds), snapshot.instances[returns.faces], 0).astype(np.uint16)
        kinds, instances = noisy_points(kinds, instances, returns, config.label_noise, (config.seed, index))
        return returns.points, returns.offsets_s, returns.rings.astype(np.uint16), kinds, instances

    def raw_image(self, position: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint16]]:
        """Picture (h, w, 3), kinds and instances (h, w) of a frame, without its scan."""
        return self._image(self._checked(position))

    def _image(self, index: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint16]]:
        """Picture and labels of image ``index``."""
        light, kinds, numbers = self.look_through(index, self.camera)
        of_noise = index + _FRAMES_APART * self.camera_number
        pixels = developed(light, np.random.default_rng([self.config.seed, 30, of_noise]))
        return pixels, *noisy_mask(kinds, numbers, self.config.label_noise, (self.config.seed, of_noise))

    def look_through(
        self, index: int, camera: PinholeCamera, cRv: FloatArray | None = None
    ) -> tuple[NDArray[Any], NDArray[np.uint8], NDArray[np.uint16]]:
        """What a pinhole in the place of the camera sees at image ``index``, before blur, noise and mistakes.

        Args:
            cRv: (3, 3) rotation of that pinhole in the camera frame; the camera's own by default.

        Returns:
            (h, w, 3) float light, (h, w) kinds, (h, w) instances.
        """
        stamp_s = self.stamps_ns[index] * 1e-9
        snapshot = self.street.snapshot(stamp_s + self.config.time_offset_s, VIEW_RANGE_M)
        pose = self.wTc(stamp_s)
        rotation = np.asarray(pose.rotation().matrix())
        if cRv is not None:
            rotation = rotation @ cRv
        view = CameraView(camera, rotation, np.asarray(pose.translation()))
        triangles = snapshot.mesh.triangles
        seen = view.in_sight(triangles)
        faces, depth = cast_image(view.to_camera(triangles.take(seen, axis=0)), camera)
        faces = np.append(seen, -1)[faces]  # -1 stays -1
        light = shade(view, snapshot.mesh, faces, depth, self.look)
        kinds = np.where(faces >= 0, snapshot.mesh.kinds[faces], np.uint8(FaceKind.SKY)).astype(np.uint8)
        numbers = np.where(is_instance(kinds), snapshot.instances[faces], 0).astype(np.uint16)
        return light, kinds, numbers


_FRAMES_APART = 1_000_002
"""The noise of a further camera is that of frames so much later."""


@lru_cache(maxsize=2)
def _textures(seed: int) -> tuple[Atlas, Atlas, NDArray[np.uint8]]:
    """Materials, fine grain and sky of a seed (some 60 MB, 0.3 s: kept for the last two seeds)."""
    rng = np.random.default_rng([seed, 11])
    return material_atlas(rng), detail_atlas(rng), sky_panorama(rng)


def mounting_error(config: SimulationConfig, rng: np.random.Generator) -> gtsam.Pose3:
    """From the nominal to the true extrinsic, in the LiDAR's frame: of the configured size, any direction."""
    axis, way = rng.standard_normal(3), rng.standard_normal(3)
    turn = np.deg2rad(config.rotation_error_deg) * axis / np.linalg.norm(axis)
    shift = config.translation_error_m * way / np.linalg.norm(way)
    return gtsam.Pose3(gtsam.Rot3.Expmap(turn), shift)


def simulate(config: SimulationConfig) -> SimulatedDrive:
    """The drive of a configuration: the street is built now, frames are made when asked for."""
    rng = np.random.default_rng([config.seed, 10])
    focal = KITTI_FOCAL_PX * config.width / KITTI_WIDTH_PX
    centre = (KITTI_CENTRE[0] * config.width, KITTI_CENTRE[1] * config.height)
    camera = PinholeCamera(focal, focal, *centre, config.width, config.height)
    truth = GroundTruth(NOMINAL_CTL * mounting_error(config, rng), config.time_offset_s)
    # Whole microseconds, so that times.txt says the same as the frames.
    jitter = rng.normal(0.0, 0.00017, config.frames)
    jitter[0] = 0.0
    stamps = np.rint((np.arange(config.frames) * config.period_s + jitter) * 1e6).astype(np.int64) * 1000
    street = build_street(config)
    return SimulatedDrive(config, camera, NOMINAL_CTL, truth, street, stamps)
