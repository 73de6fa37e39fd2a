"""Drives with faults that leave them plausible: timing, labels, pictures and clouds that are a little wrong.

``SUBTLE_FAULTS`` maps the name of each to a function of the drive; ``studies/wrong_input.py --subtle``
tries them. A fault either does no harm, or the result must not be ``ok``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from sst_graph.data.kept_drive import KeptDrive
from sst_graph.experiments.wrong_drives import with_elevation
from sst_graph.types import CameraImage, Frame, Scan, SemanticClass

FloatArray = NDArray[np.float64]
SubtleFault = Callable[[KeptDrive], KeptDrive]


def with_numbered_scans(drive: KeptDrive, change: Callable[[int, Scan], Scan]) -> KeptDrive:
    """Every scan changed by its position in the drive."""
    frames = [f if f.scan is None else replace(f, scan=change(k, f.scan)) for k, f in enumerate(drive.frames)]
    return replace(drive, frames=tuple(frames))


def with_numbered_images(drive: KeptDrive, change: Callable[[int, CameraImage], CameraImage]) -> KeptDrive:
    """Every image changed by its position in the drive."""
    frames = [
        f if f.image is None else replace(f, image=change(k, f.image)) for k, f in enumerate(drive.frames)
    ]
    return replace(drive, frames=tuple(frames))


def taken(scan: Scan, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> Scan:
    """Some points of a scan, with all that is said of them."""
    parts = {
        name: getattr(scan, name)[chosen]
        for name in ("points", "classes", "instances", "offsets_s", "rings")
        if getattr(scan, name) is not None
    }
    bare = Scan(scan.stamp_ns, scan.points, scan.classes, scan.instances, scan.offsets_s, scan.rings)
    return replace(bare, **parts)


def _azimuth_deg(scan: Scan) -> FloatArray:
    return np.asarray(np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0])), np.float64)


def _elevation_deg(scan: Scan) -> FloatArray:
    across = np.hypot(scan.points[:, 0], scan.points[:, 1])
    return np.asarray(np.degrees(np.arctan2(scan.points[:, 2], across)), np.float64)


# ---------------------------------------------------------------------- time


def repeated_pictures(drive: KeptDrive, every: int = 2) -> KeptDrive:
    """Of every few images the last is the one before it again: a driver that publishes its last buffer."""
    images = [f.image for f in drive.frames]

    def held(k: int, image: CameraImage) -> CameraImage:
        first = images[k - 1] if k % every == every - 1 else image
        return image if first is None else replace(first, stamp_ns=image.stamp_ns)

    return with_numbered_images(drive, held)


def repeated_scans(drive: KeptDrive, every: int = 2) -> KeptDrive:
    """The same of scans."""
    scans = [f.scan for f in drive.frames]

    def held(k: int, scan: Scan) -> Scan:
        first = scans[k - 1] if k % every == every - 1 else scan
        return scan if first is None else replace(first, stamp_ns=scan.stamp_ns)

    return with_numbered_scans(drive, held)


def rounded_stamps(drive: KeptDrive, milliseconds: int = 100) -> KeptDrive:
    """Scan stamps cut to multiples of some milliseconds, each at least that after the one before."""
    step, last = milliseconds * 10**6, [-1]

    def cut(scan: Scan) -> Scan:
        last[0] = max(scan.stamp_ns // step, last[0] + 1)
        return replace(scan, stamp_ns=last[0] * step)

    return drive.with_scans(cut)


def stepped_scan_stamps(drive: KeptDrive, milliseconds: float) -> KeptDrive:
    """The LiDAR's clock is set in the middle of the drive."""
    step, middle = round(1e6 * milliseconds), len(drive) // 2
    return with_numbered_scans(drive, lambda k, s: replace(s, stamp_ns=s.stamp_ns + step * (k >= middle)))


def stepped_stamps(drive: KeptDrive, milliseconds: float) -> KeptDrive:
    """Both clocks are set in the middle of the drive."""
    step, middle = round(1e6 * milliseconds), len(drive) // 2
    later = stepped_scan_stamps(drive, milliseconds)
    return with_numbered_images(later, lambda k, i: replace(i, stamp_ns=i.stamp_ns + step * (k >= middle)))


def jittered_images(drive: KeptDrive, milliseconds: float) -> KeptDrive:
    """Images stamped when they arrive, up to some milliseconds late."""
    rng = np.random.default_rng(11)
    return drive.with_images(
        lambda i: replace(i, stamp_ns=i.stamp_ns + round(1e6 * milliseconds * rng.uniform()))
    )


def late_masks(drive: KeptDrive) -> KeptDrive:
    """Each image under the mask of the one before it."""
    images = [f.image for f in drive.frames]

    def masked(k: int, image: CameraImage) -> CameraImage:
        former = images[max(k - 1, 0)] or image
        return replace(image, mask=former.mask, instances=former.instances)

    return with_numbered_images(drive, masked)


def backwards(drive: KeptDrive) -> KeptDrive:
    """Both sensors' recordings played backwards under stamps that run on.

    That is a vehicle in reverse whose images are as much early as they were late: so the truth.
    """
    scans = [f.scan for f in reversed(drive.frames)]
    images = [f.image for f in reversed(drive.frames)]
    frames = []
    for frame, scan, image in zip(drive.frames, scans, images, strict=True):
        if frame.scan is None or frame.image is None or scan is None or image is None:
            continue
        scan = replace(scan, stamp_ns=frame.scan.stamp_ns)
        frames.append(Frame(frame.index, scan, replace(image, stamp_ns=frame.image.stamp_ns)))
    between_s = [1e-9 * (f.image.stamp_ns - f.scan.stamp_ns) for f in frames if f.image and f.scan]
    turned = replace(drive, frames=tuple(frames))
    return with_true_offset(turned, lambda offset_s: -offset_s - 2.0 * float(np.median(between_s)))


def with_true_offset(drive: KeptDrive, change: Callable[[float], float]) -> KeptDrive:
    """The drive with another true time offset, where one is known [s]."""
    truth = drive.truth
    if truth is None or truth.time_offset_s is None:
        return drive
    return replace(drive, truth=replace(truth, time_offset_s=change(truth.time_offset_s)))


def scans_backwards(drive: KeptDrive) -> KeptDrive:
    """The scans played backwards, the images not."""
    scans = [f.scan for f in reversed(drive.frames)]
    return with_numbered_scans(drive, lambda k, s: replace(scans[k] or s, stamp_ns=s.stamp_ns))


# -------------------------------------------------------------------- labels


def _grown(image: CameraImage, pixels: int) -> CameraImage:
    """Vehicles of the mask wider by some pixels on every side; narrower where it is negative."""
    vehicle = (image.mask == SemanticClass.VEHICLE).astype(np.uint8)
    kernel = np.ones((2 * abs(pixels) + 1,) * 2, np.uint8)
    mask = image.mask.copy()
    if pixels > 0:
        mask[cv2.dilate(vehicle, kernel) > 0] = SemanticClass.VEHICLE
    else:
        mask[(vehicle > 0) & (cv2.erode(vehicle, kernel) == 0)] = SemanticClass.OTHER
    return replace(image, mask=mask, instances=None)


def grown_on_one_side(drive: KeptDrive, pixels: int) -> KeptDrive:
    """Vehicles of the masks drawn out to the right: a network whose stride was padded on one side."""

    def drawn(image: CameraImage) -> CameraImage:
        mask = image.mask.copy()
        vehicle = mask == SemanticClass.VEHICLE
        for step in range(1, pixels + 1):
            mask[:, step:][vehicle[:, :-step]] = SemanticClass.VEHICLE
        return replace(image, mask=mask, instances=None)

    return drive.with_images(drawn)


def coarse_masks(drive: KeptDrive, factor: int = 8) -> KeptDrive:
    """Masks made at a fraction of the size and enlarged by their top left pixels."""

    def coarse(image: CameraImage) -> CameraImage:
        mask = np.repeat(np.repeat(image.mask[::factor, ::factor], factor, 0), factor, 1)
        rows, columns = image.mask.shape
        return replace(image, mask=mask[:rows, :columns].copy(), instances=None)

    return drive.with_images(coarse)


def exchanged_classes(drive: KeptDrive) -> KeptDrive:
    """Vehicle and building exchanged in the masks alone."""
    table = np.arange(256, dtype=np.uint8)
    table[[1, 3]] = [3, 1]
    return drive.with_images(lambda i: replace(i, mask=table[i.mask], instances=None))


def labels_of_former_scan(drive: KeptDrive) -> KeptDrive:
    """Each scan under the label file of the one before it, point by point."""
    scans = [f.scan for f in drive.frames]

    def labelled(k: int, scan: Scan) -> Scan:
        former = scans[max(k - 1, 0)] or scan
        classes = np.resize(former.classes, len(scan.classes))
        instances = None if former.instances is None else np.resize(former.instances, len(classes))
        return replace(scan, classes=classes, instances=instances)

    return with_numbered_scans(drive, labelled)


# --------------------------------------------------------------------- clouds


def accumulated(drive: KeptDrive) -> KeptDrive:
    """Each cloud is that of three scans laid over each other as they are, stamped as the newest."""
    scans = [f.scan for f in drive.frames]

    def together(k: int, scan: Scan) -> Scan:
        own = [s for s in scans[max(k - 2, 0) : k + 1] if s is not None]
        points = np.concatenate([s.points for s in own])
        classes = np.concatenate([s.classes for s in own])
        return Scan(scan.stamp_ns, points, classes)

    return with_numbered_scans(drive, together)


def shuffled_points(drive: KeptDrive) -> KeptDrive:
    """The points of each scan in any order."""
    rng = np.random.default_rng(12)
    return drive.with_scans(lambda s: taken(s, rng.permutation(len(s.points))))


def half_beams(drive: KeptDrive) -> KeptDrive:
    """Every second beam dead: stripes of elevation without points."""
    return drive.with_scans(lambda s: taken(s, (_elevation_deg(s) / 0.8) % 1.0 < 0.5))


def dead_sector(drive: KeptDrive, first_deg: float = 0.0, last_deg: float = 20.0) -> KeptDrive:
    """No points within a sector of azimuth: dirt on the window."""
    return drive.with_scans(lambda s: taken(s, (_azimuth_deg(s) < first_deg) | (_azimuth_deg(s) > last_deg)))


def with_own_body(drive: KeptDrive) -> KeptDrive:
    """The bonnet of the own vehicle in every cloud, labelled vehicle as networks do."""
    x, y = np.meshgrid(np.linspace(0.8, 2.4, 40), np.linspace(-0.8, 0.8, 40))
    body = np.stack([x.ravel(), y.ravel(), np.full(x.size, -0.7)], axis=1).astype(np.float32)

    def seen(scan: Scan) -> Scan:
        points = np.concatenate([scan.points, body])
        classes = np.concatenate([scan.classes, np.full(len(body), SemanticClass.VEHICLE, np.uint8)])
        instances = None
        if scan.instances is not None:
            instances = np.concatenate([scan.instances, np.zeros(len(body), np.uint16)])
        return Scan(scan.stamp_ns, points, classes, instances)

    return drive.with_scans(seen)


def scaled_ranges(drive: KeptDrive, factor: float) -> KeptDrive:
    """Ranges longer by a factor."""
    return drive.with_scans(lambda s: replace(s, points=(factor * s.points).astype(np.float32)))


def tilting(drive: KeptDrive, degrees: float) -> KeptDrive:
    """The LiDAR's mount gives way evenly, by so much over the drive, about its y axis."""

    def tilted(k: int, scan: Scan) -> Scan:
        R = gtsam.Rot3.Ry(np.radians(degrees) * k / max(len(drive) - 1, 1)).matrix()
        return replace(scan, points=(scan.points.astype(np.float64) @ R.T).astype(np.float32))

    return with_numbered_scans(drive, tilted)


def knocked(drive: KeptDrive, degrees: float) -> KeptDrive:
    """The LiDAR is tilted about its y axis from the middle of the drive on."""
    R, middle = gtsam.Rot3.Ry(np.radians(degrees)).matrix(), len(drive) // 2

    def tilted(k: int, scan: Scan) -> Scan:
        if k < middle:
            return scan
        return replace(scan, points=(scan.points.astype(np.float64) @ R.T).astype(np.float32))

    return with_numbered_scans(drive, tilted)


# ------------------------------------------------------------------- pictures


def with_warped_pictures(
    drive: KeptDrive, warp: Callable[[NDArray[np.uint8], int], NDArray[np.uint8]]
) -> KeptDrive:
    """Pictures and masks by ``warp``, which takes an array and how to interpolate."""
    return drive.with_images(
        lambda i: replace(
            i,
            mask=warp(i.mask, cv2.INTER_NEAREST),
            pixels=warp(i.pixels, cv2.INTER_LINEAR),
            instances=None,
        )
    )


def cropped(drive: KeptDrive, share: float = 0.9) -> KeptDrive:
    """The middle of pictures and masks blown up to the full size, where a smaller picture was expected."""
    width, height = drive.camera.width, drive.camera.height
    w, h = round(share * width), round(share * height)
    u, v = (width - w) // 2, (height - h) // 2

    def blown_up(array: NDArray[np.uint8], how: int) -> NDArray[np.uint8]:
        return cv2.resize(array[v : v + h, u : u + w], (width, height), interpolation=how)

    return with_warped_pictures(drive, blown_up)


def cut_off(drive: KeptDrive, columns: int, rows: int) -> KeptDrive:
    """Columns on the left and rows at the top cut off pictures and masks, the principal point as before."""
    width, height = drive.camera.width - columns, drive.camera.height - rows
    smaller = drive.with_images(
        lambda i: replace(
            i, mask=i.mask[rows:, columns:].copy(), pixels=i.pixels[rows:, columns:].copy(), instances=None
        )
    )
    return replace(smaller, camera=replace(drive.camera, width=width, height=height))


def upside_down_pictures(drive: KeptDrive) -> KeptDrive:
    """Pictures and masks turned by 180 deg."""
    return drive.with_images(
        lambda i: replace(
            i, mask=i.mask[::-1, ::-1].copy(), pixels=i.pixels[::-1, ::-1].copy(), instances=None
        )
    )


def with_dashboard(drive: KeptDrive, vehicle: bool) -> KeptDrive:
    """The lowest fifth of the pictures hidden by a dashboard, labelled vehicle or as background."""
    rng = np.random.default_rng(13)
    rows = drive.camera.height // 5
    texture = rng.integers(0, 80, (rows, drive.camera.width, 3)).astype(np.uint8)
    label = SemanticClass.VEHICLE if vehicle else SemanticClass.OTHER

    def hidden(image: CameraImage) -> CameraImage:
        mask, pixels = image.mask.copy(), image.pixels.copy()
        mask[-rows:], pixels[-rows:] = label, texture
        return replace(image, mask=mask, pixels=pixels, instances=None)

    return drive.with_images(hidden)


def with_watermark(drive: KeptDrive) -> KeptDrive:
    """White letters over the middle of every picture, as large as a fifth of it; masks as they were."""

    def marked(image: CameraImage) -> CameraImage:
        pixels = np.ascontiguousarray(image.pixels.copy())
        size = pixels.shape[0] / 90.0
        at = (pixels.shape[1] // 8, 2 * pixels.shape[0] // 3)
        cv2.putText(pixels, "DEMO VERSION", at, cv2.FONT_HERSHEY_SIMPLEX, size, (255, 255, 255), 6)
        return replace(image, pixels=pixels)

    return drive.with_images(marked)


def sheared(drive: KeptDrive, pixels: float) -> KeptDrive:
    """The last row of pictures and masks this far right of the first: rows exposed in turn in a bend."""
    shape = (drive.camera.width, drive.camera.height)
    M = np.array([[1.0, pixels / shape[1], -0.5 * pixels], [0.0, 1.0, 0.0]])

    def slanted(array: NDArray[np.uint8], how: int) -> NDArray[np.uint8]:
        return cv2.warpAffine(array, M, shape, flags=how, borderMode=cv2.BORDER_REPLICATE)

    return with_warped_pictures(drive, slanted)


# ---------------------------------------------------------------------- further ones


def mirrored_masks(drive: KeptDrive) -> KeptDrive:
    """Masks mirrored, the pictures not: a network that was fed flipped pictures."""
    return drive.with_images(
        lambda i: replace(
            i,
            mask=np.ascontiguousarray(i.mask[:, ::-1]),
            instances=None if i.instances is None else np.ascontiguousarray(i.instances[:, ::-1]),
        )
    )


def next_masks(drive: KeptDrive) -> KeptDrive:
    """Each image under the mask of the one after it."""
    images = [f.image for f in drive.frames]

    def masked(k: int, image: CameraImage) -> CameraImage:
        after = images[min(k + 1, len(images) - 1)] or image
        return replace(image, mask=after.mask, instances=after.instances)

    return with_numbered_images(drive, masked)


def another_epoch(drive: KeptDrive, seconds: int) -> KeptDrive:
    """The camera counts from another instant than the LiDAR, and so the truth."""
    later = drive.with_images(lambda i: replace(i, stamp_ns=i.stamp_ns + seconds * 10**9))
    return with_true_offset(later, lambda offset_s: offset_s - seconds)


def reordered_rings(drive: KeptDrive) -> KeptDrive:
    """Laser numbers in the order of another scanner."""
    order = np.random.default_rng(5).permutation(4096).astype(np.uint16)
    return drive.with_scans(lambda s: s if s.rings is None else replace(s, rings=order[s.rings % 4096]))


def hurried_scans(drive: KeptDrive) -> KeptDrive:
    """Every second scan, under the stamps of the scans from the first one on."""
    scans = [f.scan for f in drive.frames if f.scan is not None]
    frames = []
    for k, frame in enumerate(drive.frames):
        there = frame.scan is not None and 2 * k < len(scans)
        scan = replace(scans[2 * k], stamp_ns=frame.scan.stamp_ns) if there and frame.scan else None
        frames.append(replace(frame, scan=scan))
    return replace(drive, frames=tuple(frames))


def labelled_on_one_side(drive: KeptDrive) -> KeptDrive:
    """Masks whose right half is background: tiles that were never joined."""

    def half(image: CameraImage) -> CameraImage:
        mask = image.mask.copy()
        mask[:, mask.shape[1] // 2 :] = SemanticClass.OTHER
        return replace(image, mask=mask)

    return drive.with_images(half)


def turned_about_x(drive: KeptDrive, degrees: float) -> KeptDrive:
    """The clouds are turned about their x axis."""
    R = gtsam.Rot3.Rx(np.radians(degrees)).matrix()
    return drive.with_scans(lambda s: replace(s, points=(s.points @ R.T).astype(np.float32)))


def binned_pictures(drive: KeptDrive, left: int) -> KeptDrive:
    """Pictures and masks begin some columns farther left, as those of another mode of the sensor."""

    def moved(array: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.ascontiguousarray(np.roll(array, left, axis=1))

    return drive.with_images(lambda i: replace(i, mask=moved(i.mask), pixels=moved(i.pixels), instances=None))


def of_another_day(drive: KeptDrive) -> KeptDrive:
    """Intrinsics as of another recording day: focal length +0.2 %, principal point 2.5 and 10.5 px away."""
    camera = drive.camera
    other = replace(
        camera, fx=1.002 * camera.fx, fy=1.002 * camera.fy, cx=camera.cx - 2.5, cy=camera.cy + 10.5
    )
    return replace(drive, camera=other)


def raised_lidar(drive: KeptDrive, metres: float) -> KeptDrive:
    """The mount of the LiDAR slips by so much along its z axis in the middle of the drive."""
    middle = len(drive) // 2
    step = np.array([0.0, 0.0, metres], np.float32)
    return with_numbered_scans(drive, lambda k, s: s if k < middle else replace(s, points=s.points - step))


def stamped_early(drive: KeptDrive, seconds: float) -> KeptDrive:
    """Scans stamped by the start of their turn, not by its middle, and so the truth."""
    early = round(1e9 * seconds)
    stamped = with_numbered_scans(drive, lambda k, s: replace(s, stamp_ns=s.stamp_ns - early))
    return with_true_offset(stamped, lambda offset_s: offset_s - seconds)


def stretched(drive: KeptDrive, factor: float) -> KeptDrive:
    """Pictures and masks higher by a factor about their middle row, the focal lengths as before."""
    shape = (drive.camera.width, drive.camera.height)
    M = np.array([[1.0, 0.0, 0.0], [0.0, factor, 0.5 * shape[1] * (1.0 - factor)]])
    return with_warped_pictures(
        drive, lambda array, how: cv2.warpAffine(array, M, shape, flags=how, borderMode=cv2.BORDER_REPLICATE)
    )


def tangentially_distorted(drive: KeptDrive, p1: float) -> KeptDrive:
    """A lens that stands askew: plumb-bob distortion p1, which the camera does not know."""
    camera = drive.camera
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2).astype(np.float64)
    at = cv2.undistortPoints(pixels, K, np.array([0.0, 0.0, p1, 0.0]), P=K)
    at = at.reshape(camera.height, camera.width, 2).astype(np.float32)
    return with_warped_pictures(
        drive, lambda array, how: cv2.remap(array, at, None, how, borderMode=cv2.BORDER_REPLICATE)
    )


def in_polar(scan: Scan, azimuth: FloatArray, elevation: FloatArray) -> Scan:
    """A scan whose points have other azimuths and elevations [rad] and the same ranges."""
    ranges = np.linalg.norm(scan.points.astype(np.float64), axis=1)
    across = ranges * np.cos(elevation)
    points = [across * np.cos(azimuth), across * np.sin(azimuth), ranges * np.sin(elevation)]
    return replace(scan, points=np.stack(points, axis=1).astype(np.float32))


def wider_beams(drive: KeptDrive, factor: float) -> KeptDrive:
    """Elevations larger by a factor: the table of the beams is that of another LiDAR of the kind."""
    return drive.with_scans(
        lambda s: in_polar(s, np.radians(_azimuth_deg(s)), factor * np.radians(_elevation_deg(s)))
    )


def eccentric_encoder(drive: KeptDrive, degrees: float) -> KeptDrive:
    """Azimuths wrong by a sine of themselves: the encoder's disc is not centred."""

    def turned(scan: Scan) -> Scan:
        azimuth = np.radians(_azimuth_deg(scan))
        wrong = azimuth + np.radians(degrees) * np.sin(azimuth + 0.5)
        return in_polar(scan, wrong, np.radians(_elevation_deg(scan)))

    return drive.with_scans(turned)


def bleeding_labels(drive: KeptDrive, degrees: float, one_side: bool) -> KeptDrive:
    """Points beside a vehicle labelled vehicle, whatever their range: networks on range images do so."""
    window = np.radians(degrees)

    def labelled(scan: Scan) -> Scan:
        direction = np.stack([np.radians(_azimuth_deg(scan)), 3.0 * np.radians(_elevation_deg(scan))], axis=1)
        vehicle = scan.classes == SemanticClass.VEHICLE
        if not vehicle.any() or vehicle.all():
            return scan
        shifted = direction - ([0.5 * window, 0.0] if one_side else [0.0, 0.0])
        reach = 0.5 * window if one_side else window
        near = KDTree(direction[vehicle]).query(shifted, distance_upper_bound=reach)[0] < np.inf
        classes = scan.classes.copy()
        classes[near] = SemanticClass.VEHICLE
        return replace(scan, classes=classes, instances=None)

    return drive.with_scans(labelled)


def noisy_ranges(drive: KeptDrive, metres: float) -> KeptDrive:
    """Ranges with a normal error: a cheap LiDAR."""
    rng = np.random.default_rng(14)

    def noisy(scan: Scan) -> Scan:
        ranges = np.linalg.norm(scan.points, axis=1, keepdims=True)
        longer = 1.0 + metres * rng.standard_normal((len(ranges), 1)) / np.maximum(ranges, 0.5)
        return replace(scan, points=(scan.points * longer).astype(np.float32))

    return drive.with_scans(noisy)


def lowered_masks(drive: KeptDrive, rows: int) -> KeptDrive:
    """Masks some rows lower than the pictures: padded at the top and not cut again."""
    return drive.with_images(
        lambda i: replace(
            i, mask=np.concatenate([np.repeat(i.mask[:1], rows, 0), i.mask[:-rows]]), instances=None
        )
    )


SUBTLE_FAULTS: dict[str, SubtleFault] = {
    "every second picture repeated": repeated_pictures,
    "every second scan repeated": repeated_scans,
    "scan stamps cut to 100 ms": rounded_stamps,
    "scan stamps +30 ms from the middle on": lambda d: stepped_scan_stamps(d, 30.0),
    "all stamps +500 ms from the middle on": lambda d: stepped_stamps(d, 500.0),
    "images stamped up to 60 ms late": lambda d: jittered_images(d, 60.0),
    "masks one frame late": late_masks,
    "played backwards": backwards,
    "scans played backwards": scans_backwards,
    "masks 3 px wider": lambda d: d.with_images(lambda i: _grown(i, 3)),
    "masks 3 px narrower": lambda d: d.with_images(lambda i: _grown(i, -3)),
    "masks drawn out 6 px to the right": lambda d: grown_on_one_side(d, 6),
    "masks at an eighth of the size": coarse_masks,
    "vehicle and building exchanged in masks": exchanged_classes,
    "labels of the scan before": labels_of_former_scan,
    "three scans in one cloud": accumulated,
    "points in any order": shuffled_points,
    "every second beam dead": half_beams,
    "20 deg of azimuth dead": dead_sector,
    "own bonnet in the cloud": with_own_body,
    "ranges 1 % long": lambda d: scaled_ranges(d, 1.01),
    "ranges 3 % long": lambda d: scaled_ranges(d, 1.03),
    "beams 0.3 deg high": lambda d: with_elevation(d, np.radians(-0.3)),
    "LiDAR tilts by 1 deg over the drive": lambda d: tilting(d, 1.0),
    "LiDAR tilted by 3 deg in the middle": lambda d: knocked(d, 3.0),
    "middle 90 % blown up": cropped,
    "20 columns, 10 rows cut off": lambda d: cut_off(d, 20, 10),
    "pictures turned by 180 deg": upside_down_pictures,
    "dashboard, labelled vehicle": lambda d: with_dashboard(d, True),
    "dashboard, labelled background": lambda d: with_dashboard(d, False),
    "watermark": with_watermark,
    "pictures sheared by 6 px": lambda d: sheared(d, 6.0),
    "masks mirrored, pictures not": mirrored_masks,
    "masks one frame early": next_masks,
    "camera in another epoch": lambda d: another_epoch(d, 37),
    "laser numbers reordered": reordered_rings,
    "every second scan, stamps of all": hurried_scans,
    "masks of the left half only": labelled_on_one_side,
    "clouds turned by 90 deg about x": lambda d: turned_about_x(d, 90.0),
    "pictures 15 columns to the right": lambda d: binned_pictures(d, 15),
    "intrinsics of another day": of_another_day,
    "LiDAR slips by 10 cm in the middle": lambda d: raised_lidar(d, 0.1),
    "LiDAR tilted by 1 deg in the middle": lambda d: knocked(d, 1.0),
    "scans stamped 50 ms early": lambda d: stamped_early(d, 0.05),
    "pictures stretched by 2 % in height": lambda d: stretched(d, 1.02),
    "lens askew, p1 = 0.004": lambda d: tangentially_distorted(d, 0.004),
    "beams 2 % farther apart": lambda d: wider_beams(d, 1.02),
    "azimuths eccentric by 0.2 deg": lambda d: eccentric_encoder(d, 0.2),
    "labels of clouds 0.4 deg too wide": lambda d: bleeding_labels(d, 0.4, False),
    "labels of clouds 0.4 deg too wide on one side": lambda d: bleeding_labels(d, 0.4, True),
    "ranges with errors of 8 cm": lambda d: noisy_ranges(d, 0.08),
    "masks 4 rows low": lambda d: lowered_masks(d, 4),
}

SUBTLE_NAMED: dict[str, str] = {
    "every second picture repeated": "pictures are repeated",
    "every second scan repeated": "scans are repeated",
    "three scans in one cloud": "several scans laid over each other",
}
"""Words of the sentence that names a fault before anything is solved."""
