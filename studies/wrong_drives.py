"""Drives made wrong on purpose, each in one way that happens to people: units, axes, sizes, stamps, labels.

``INPUT_FAULTS`` maps the name of each to a function of the drive; studies/wrong_input.py tries them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.data.kept_drive import KeptDrive
from sst_graph.simulator import SimulatedDrive
from sst_graph.types import CameraImage, Frame, Scan, SemanticClass

FloatArray = NDArray[np.float64]

BASELINE_M = 0.54
"""Between the two colour cameras of KITTI's rig [m]."""


def with_points(drive: KeptDrive, M: FloatArray) -> KeptDrive:
    """Every point multiplied by M (3, 3)."""
    return drive.with_scans(lambda s: replace(s, points=(s.points @ M.T).astype(np.float32)))


def with_camera(drive: KeptDrive, focal: float) -> KeptDrive:
    """Another focal length."""
    c = drive.camera
    return replace(drive, camera=replace(c, fx=focal * c.fx, fy=focal * c.fy))


def resized(drive: KeptDrive, scale: float) -> KeptDrive:
    """Pictures and masks of another size, the camera's size following them, its focal length not."""
    c = drive.camera
    size = (round(c.width * scale), round(c.height * scale))
    smaller = drive.with_images(lambda i: _resized(i, size, pictures=True))
    return replace(smaller, camera=replace(c, width=size[0], height=size[1]))


def with_stamps(drive: KeptDrive, factor: int, divisor: int = 1) -> KeptDrive:
    """All stamps multiplied by a fraction."""
    later = drive.with_scans(lambda s: replace(s, stamp_ns=s.stamp_ns * factor // divisor))
    return later.with_images(lambda i: replace(i, stamp_ns=i.stamp_ns * factor // divisor))


def with_images_of(drive: KeptDrive, others: Sequence[Frame], pictures: bool = True) -> KeptDrive:
    """Images (or only their masks) of other frames, at this drive's stamps."""
    frames = []
    for frame, other in zip(drive.frames, others, strict=False):
        if frame.image is None or other.image is None:
            continue
        image = replace(frame.image, mask=other.image.mask, instances=other.image.instances)
        if pictures:
            image = replace(image, pixels=other.image.pixels)
        frames.append(replace(frame, image=image))
    return replace(drive, frames=tuple(frames))


InputFault = Callable[[KeptDrive, KeptDrive], KeptDrive]
"""From a drive, and another one, to the wrong drive; the calibration starts from its nominal pose."""


def _with(frame: Frame, **change: Scan | CameraImage | None) -> Frame:
    return replace(frame, **change)


def _resized(image: CameraImage, size: tuple[int, int], pictures: bool) -> CameraImage:
    mask = cv2.resize(image.mask, size, interpolation=cv2.INTER_NEAREST)
    pixels = cv2.resize(image.pixels, size, interpolation=cv2.INTER_AREA) if pictures else image.pixels
    return replace(image, mask=mask, pixels=pixels, instances=None)


def _mirrored(image: CameraImage) -> CameraImage:
    instances = None if image.instances is None else image.instances[:, ::-1].copy()
    return replace(
        image, mask=image.mask[:, ::-1].copy(), pixels=image.pixels[:, ::-1].copy(), instances=instances
    )


def shifted_masks(drive: KeptDrive, du: int, dv: int) -> KeptDrive:
    """Masks moved right and down against their pictures by whole pixels [px]."""

    def moved(image: CameraImage) -> CameraImage:
        mask = np.roll(image.mask, (dv, du), (0, 1))
        for cut in (np.s_[:dv] if dv > 0 else np.s_[mask.shape[0] + dv :] if dv < 0 else np.s_[:0],):
            mask[cut] = SemanticClass.IGNORE
        if du:
            mask[:, slice(0, du) if du > 0 else slice(mask.shape[1] + du, None)] = SemanticClass.IGNORE
        return replace(image, mask=mask, instances=None)

    return drive.with_images(moved)


def _half_masks(drive: KeptDrive) -> KeptDrive:
    size = (drive.camera.width // 2, drive.camera.height // 2)
    return drive.with_images(lambda image: _resized(image, size, pictures=False))


def _background_only(drive: KeptDrive) -> KeptDrive:
    def bare(scan: Scan) -> Scan:
        return replace(scan, classes=np.zeros_like(scan.classes), instances=None)

    empty = drive.with_scans(bare)
    return empty.with_images(lambda i: replace(i, mask=np.zeros_like(i.mask), instances=None))


def _permuted(drive: KeptDrive) -> KeptDrive:
    """Point classes renamed in a circle, as where an id table of another data set is used."""
    table = np.arange(256, dtype=np.uint8)
    named = [int(c) for c in (SemanticClass.VEHICLE, SemanticClass.GROUND, SemanticClass.BUILDING)]
    table[named] = named[1:] + named[:1]
    return drive.with_scans(lambda s: replace(s, classes=table[s.classes], instances=None))


def _repeated(drive: KeptDrive, scans: bool) -> KeptDrive:
    """The first scan's, or image's, contents in every frame under the frame's own stamp."""
    first = drive.frames[0]
    if scans:
        assert first.scan is not None
        held = first.scan
        return drive.with_scans(lambda s: replace(held, stamp_ns=s.stamp_ns))
    assert first.image is not None
    shown = first.image
    return drive.with_images(lambda i: replace(shown, stamp_ns=i.stamp_ns))


def _later_images(drive: KeptDrive, frames: int) -> KeptDrive:
    """Every image under the number of one before it; the last scans are left without."""
    kept = with_images_of(drive, drive.frames[frames:]).frames
    return replace(drive, frames=(*kept, *(_with(f, image=None) for f in drive.frames[len(kept) :])))


def _one_clock(drive: KeptDrive, scans: float = 1.0, images: float = 1.0) -> KeptDrive:
    """The stamps of one sensor multiplied."""
    later = drive.with_scans(lambda s: replace(s, stamp_ns=round(s.stamp_ns * scans)))
    return later.with_images(lambda i: replace(i, stamp_ns=round(i.stamp_ns * images)))


def _shuffled(drive: KeptDrive) -> KeptDrive:
    order = np.random.default_rng(5).permutation(len(drive))
    return with_images_of(drive, [drive.frames[i] for i in order], pictures=False)


def _nominal(drive: KeptDrive, change: Callable[[gtsam.Pose3], gtsam.Pose3]) -> KeptDrive:
    assert drive.nominal is not None
    return replace(drive, nominal=change(drive.nominal))


def _in_vehicle_axes(drive: KeptDrive) -> KeptDrive:
    """Clouds and start in axes that begin on the ground at the rear axle, as base_link; lasers unnamed."""
    pose = gtsam.Pose3(gtsam.Rot3(), np.array([1.4, 0.0, 1.8]))
    moved = drive.with_scans(
        lambda s: replace(s, points=s.points + pose.translation().astype(np.float32), rings=None)
    )
    return _nominal(moved, lambda T: T * pose.inverse())


def _radians_as_degrees(cTl: gtsam.Pose3) -> gtsam.Pose3:
    """The camera's yaw -1.57, pitch 0, roll -1.57 in the LiDAR, given to a function that takes degrees."""
    lRc = gtsam.Rot3.Ypr(*np.radians([-0.5 * np.pi, 0.0, -0.5 * np.pi]))
    return gtsam.Pose3(lRc.inverse(), cTl.translation())


def _in_millimetres(cTl: gtsam.Pose3) -> gtsam.Pose3:
    return gtsam.Pose3(cTl.rotation(), 1000.0 * cTl.translation())


_BESIDE = gtsam.Pose3(gtsam.Rot3(), np.array([-BASELINE_M, 0.0, 0.0]))
_CAMERA_AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])

INPUT_FAULTS: dict[str, InputFault] = {
    "half-size images": lambda d, o: resized(d, 0.5),
    "half-size masks": lambda d, o: _half_masks(d),
    "stamps in ms": lambda d, o: with_stamps(d, 10**3),
    "stamps in us": lambda d, o: with_stamps(d, 10**6),
    "stamps in ns": lambda d, o: with_stamps(d, 10**9),
    "clouds in mm": lambda d, o: with_points(d, 1000.0 * np.eye(3)),
    "clouds in cm": lambda d, o: with_points(d, 100.0 * np.eye(3)),
    "clouds in feet": lambda d, o: with_points(d, np.eye(3) / 0.3048),
    "clouds in camera axes": lambda d, o: with_points(d, _CAMERA_AXES),
    "clouds in vehicle axes": lambda d, o: _in_vehicle_axes(d),
    "Tr inverted": lambda d, o: _nominal(d, lambda T: T.inverse()),
    "Tr in mm": lambda d, o: _nominal(d, _in_millimetres),
    "radians as degrees": lambda d, o: _nominal(d, _radians_as_degrees),
    "Tr of the right camera": lambda d, o: _nominal(d, lambda T: _BESIDE * T),
    "x flipped": lambda d, o: with_points(d, np.diag([-1.0, 1.0, 1.0])),
    "y flipped": lambda d, o: with_points(d, np.diag([1.0, -1.0, 1.0])),
    "turned by 180 deg": lambda d, o: with_points(d, np.diag([-1.0, -1.0, 1.0])),
    "upside down": lambda d, o: with_points(d, np.diag([1.0, -1.0, -1.0])),
    "masks of another drive": lambda d, o: with_images_of(d, o.frames, pictures=False),
    "images of another drive": lambda d, o: with_images_of(d, o.frames),
    "masks shuffled": lambda d, o: _shuffled(d),
    "images mirrored": lambda d, o: d.with_images(_mirrored),
    "labels permuted": lambda d, o: _permuted(d),
    "stamps a tenth": lambda d, o: with_stamps(d, 1, 10),
    "stamps tenfold": lambda d, o: with_stamps(d, 10),
    "stamps doubled": lambda d, o: with_stamps(d, 2),
    "image stamps doubled": lambda d, o: _one_clock(d, images=2.0),
    "image stamps tenfold": lambda d, o: _one_clock(d, images=10.0),
    "scan stamps halved": lambda d, o: _one_clock(d, scans=0.5),
    "scan stamps a tenth": lambda d, o: _one_clock(d, scans=0.1),
    "scans repeated": lambda d, o: _repeated(d, scans=True),
    "images repeated": lambda d, o: _repeated(d, scans=False),
    "half the focal length": lambda d, o: with_camera(d, 0.5),
    "twice the focal length": lambda d, o: with_camera(d, 2.0),
    "images 15 frames late": lambda d, o: _later_images(d, 15),
    "only background": lambda d, o: _background_only(d),
    "masks shifted 3 px": lambda d, o: shifted_masks(d, 3, 0),
    "masks shifted 6 px": lambda d, o: shifted_masks(d, 6, 0),
}


def right_camera(street: SimulatedDrive) -> KeptDrive:
    """A street as the right-hand camera of a stereo pair sees it, with the left one's nominal pose."""
    beside = _BESIDE * street.truth.cTl
    return KeptDrive.of(replace(street, truth=replace(street.truth, cTl=beside)), sweep="auto")


NAMED: dict[str, str] = {
    "half-size images": "the pictures are half the size",
    "half-size masks": "a mask of",
    "stamps in ms": "the stamps are in milliseconds",
    "stamps in us": "the stamps are in microseconds",
    "stamps in ns": "the stamps are in nanoseconds",
    "clouds in mm": "the clouds are in millimetres",
    "clouds in cm": "the clouds are in centimetres",
    "clouds in feet": "the clouds are in feet",
    "clouds in camera axes": "the clouds are in the camera's axes",
    "clouds in vehicle axes": "the clouds are not in the axes of the LiDAR",
    "Tr inverted": "the start (Tr) is inverted",
    "Tr in mm": "the translation of the start (Tr) is in millimetres",
    "radians as degrees": "radians that were taken as degrees",
    "Tr of the right camera": "are those of another camera",
    "x flipped": "x axis is flipped",
    "y flipped": "mirrored",
    "turned by 180 deg": "the clouds are turned by 180 deg",
    "upside down": "the clouds are upside down",
    "masks of another drive": "the masks are not those of these pictures",
    "images of another drive": "hardly show the same scene",
    "masks shuffled": "the masks are not those of these pictures",
    "images mirrored": "mirrored",
    "labels permuted": "the class numbers of the points are mixed up",
    "stamps a tenth": "the stamps run too slowly",
    "image stamps doubled": "the images' stamps run 2 times as fast",
    "image stamps tenfold": "the images' stamps run 10 times as fast",
    "scan stamps halved": "the images' stamps run 2 times as fast",
    "scan stamps a tenth": "the stamps run too slowly",
    "scans repeated": "one scan is repeated",
    "images repeated": "one picture is repeated",
    "half the focal length": "the focal length is half",
    "twice the focal length": "the focal length is twice",
    "images 15 frames late": "numbers or stamps are off",
    "only background": "no point is labelled vehicle",
    "masks shifted 3 px": "the masks are shifted right",
    "masks shifted 6 px": "the masks are shifted right",
    "right camera": "are those of another camera",
}
"""Words of the sentence that names each fault rightly; no data show that all stamps are doubled."""
