"""The summary of a drive: by what its source tells, and by a few of its frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.cameras import Rectification
from sst_graph.data.frame_parts import image_at, image_positions, scan_at, scan_positions
from sst_graph.data.images import DARK
from sst_graph.data.info.facts import SensorFacts, SourceFacts, facts_of
from sst_graph.data.info.methods import Content, missing_for
from sst_graph.sampling import evenly_spread
from sst_graph.timestamps import FAR_APART_S, apart_s
from sst_graph.types import CameraImage, Scan, SemanticClass, Source

LONG_INTERVAL = 1.5
"""An interval longer than this many times the median is a gap."""
SAMPLED = 5
"""Scans, and images, that are looked at, spread over the drive."""
_GAPS = 20
"""Gaps that are listed, the longest; all are counted."""


@dataclass(frozen=True)
class Gap:
    """A long interval between two stamps of a sensor: from ``from_ns``, ``seconds`` long."""

    from_ns: int
    seconds: float


@dataclass(frozen=True)
class SensorInfo:
    """A sensor of a drive.

    Attributes:
        place: topic or folder.
        count: number of its messages or files.
        rate_hz: by the median interval; None for fewer than two stamps.
        first_ns, last_ns: stamps; None where there is none.
        gap_count: intervals longer than LONG_INTERVAL times the median; None where not all stamps are known.
        gaps: the longest of them.
    """

    place: str
    count: int
    rate_hz: float | None
    first_ns: int | None
    last_ns: int | None
    gap_count: int | None
    gaps: tuple[Gap, ...]


@dataclass(frozen=True)
class ScanInfo:
    """Scans that were looked at.

    Attributes:
        looked_at: their number.
        points: of a scan, the median.
        left_out: points that were NaN or inf, of all of them.
        labelled_scans, labelled_points: share of scans with labels, of points with a label.
        classes: that can be aligned.
        time_span_s: from the first to the last point of a scan; None where points have no times.
        rings: laser numbers in a scan; 0 where they are not known.
    """

    looked_at: int
    points: int
    left_out: int
    labelled_scans: float
    labelled_points: float
    classes: tuple[str, ...]
    time_span_s: float | None
    rings: int


@dataclass(frozen=True)
class ImageInfo:
    """Images that were looked at.

    Attributes:
        looked_at: their number.
        pictures, masks: share of images with a picture, with a mask.
        labelled_pixels: share of pixels with a label.
        classes: that can be aligned.
    """

    looked_at: int
    pictures: float
    masks: float
    labelled_pixels: float
    classes: tuple[str, ...]


@dataclass(frozen=True)
class DriveInfo:
    """What a drive holds.

    Attributes:
        name: of the drive.
        frames: number of frames.
        camera: model, intrinsics [px] and size [px]; of pictures that are rectified as they are read also the
            ``lens``, with its own and the share of its pictures that is used.
        scan_sensor, image_sensor: numbers, rates, stamps.
        scans, images: what those looked at hold; None where there was none.
        nominal: whether the data bring a nominal extrinsic; ``nominal_reason``: where from, or why not.
        notes: sentences on what else was found.
        missing: for each method what it lacks; none where it can be used.
    """

    name: str
    frames: int
    camera: Mapping[str, Any]
    scan_sensor: SensorInfo
    image_sensor: SensorInfo
    scans: ScanInfo | None
    images: ImageInfo | None
    nominal: bool
    nominal_reason: str
    notes: tuple[str, ...]
    missing: Mapping[str, tuple[str, ...]]


def drive_info(source: Source) -> DriveInfo:
    """The summary of a drive; at most 2 SAMPLED frames are read.

    Raises:
        DataError: one of them cannot be read.
    """
    places = evenly_spread(scan_positions(source), SAMPLED)
    scans = [scan for k in places if (scan := scan_at(source, k)) is not None]
    places = evenly_spread(image_positions(source), SAMPLED)
    images = [image for k in places if (image := image_at(source, k)) is not None]
    facts = facts_of(source)
    scan_sensor = _sensor(facts.scan if facts else None, scans, len(source))
    image_sensor = _sensor(facts.image if facts else None, images, len(source))
    facts = facts or SourceFacts(
        SensorFacts("", np.zeros(0, np.int64)), SensorFacts("", np.zeros(0, np.int64))
    )
    of_scans, of_images = _scan_info(scans), _image_info(images)
    content = Content(
        scans=scan_sensor.count if scans else 0,
        images=image_sensor.count if images else 0,
        pictures=of_images is not None and of_images.pictures > 0.0,
        point_classes=frozenset(of_scans.classes if of_scans else ()),
        mask_classes=frozenset(of_images.classes if of_images else ()),
        nominal=source.nominal is not None,
        black=_black(images),
        together=_together(scan_sensor, image_sensor),
        scans_looked_at=len(scans),
        images_looked_at=len(images),
    )
    return DriveInfo(
        name=source.name,
        frames=len(source),
        camera=_camera(source),
        scan_sensor=scan_sensor,
        image_sensor=image_sensor,
        scans=of_scans,
        images=of_images,
        nominal=content.nominal,
        nominal_reason=facts.nominal,
        notes=(*facts.notes, *facts.remarks, *facts.doubts),
        missing=missing_for(content),
    )


def _camera(source: Source) -> dict[str, Any]:
    table = {"model": "pinhole", **asdict(source.camera)}
    # A view of a drive passes on what else that has to say.
    rectification = getattr(source, "rectification", None)
    if isinstance(rectification, Rectification):
        lens = asdict(rectification.model)
        model, intrinsics = rectification.model.name, lens.pop("intrinsics")
        used = round(rectification.used_share, 3)
        table["lens"] = {"model": model, **intrinsics, "distortion": lens, "used_share": used}
    return table


def _black(images: Sequence[CameraImage]) -> bool:
    """Whether no picture among the images has a bright pixel."""
    pictures = [image.pixels for image in images if image.has_picture]
    return bool(pictures) and max(int(pixels.max()) for pixels in pictures) < DARK


def _together(one: SensorInfo, other: SensorInfo) -> bool:
    """Whether two sensors measured at the same time, by their stamps."""
    if None in (one.first_ns, one.last_ns, other.first_ns, other.last_ns):
        return True
    spans = [(sensor.first_ns or 0, sensor.last_ns or 0) for sensor in (one, other)]
    return apart_s(*spans) < FAR_APART_S


def _sensor(
    facts: SensorFacts | None, sampled: Sequence[Scan] | Sequence[CameraImage], frames: int
) -> SensorInfo:
    if facts is not None:
        return sensor_info(facts)
    stamps = [one.stamp_ns for one in sampled]
    seconds = (stamps[-1] - stamps[0]) * 1e-9 if len(stamps) > 1 else 0.0
    rate = (frames - 1) / seconds if seconds > 0.0 else None
    first, last = (stamps[0], stamps[-1]) if stamps else (None, None)
    return SensorInfo("", frames if stamps else 0, rate, first, last, None, ())


def sensor_info(facts: SensorFacts) -> SensorInfo:
    """Rate and gaps of a sensor by its stamps."""
    stamps = facts.stamps_ns
    if not len(stamps):
        return SensorInfo(facts.place, 0, None, None, None, 0, ())
    first, last = int(stamps[0]), int(stamps[-1])
    if len(stamps) < 2:
        return SensorInfo(facts.place, 1, None, first, last, 0, ())
    steps = np.diff(stamps) * 1e-9
    median = float(np.median(steps))
    long = np.flatnonzero(steps > LONG_INTERVAL * median)
    longest = np.sort(long[np.argsort(-steps[long], kind="stable")[:_GAPS]])
    gaps = tuple(Gap(int(stamps[k]), float(steps[k])) for k in longest)
    rate = 1.0 / median if median > 0.0 else None
    return SensorInfo(facts.place, len(stamps), rate, first, last, len(long), gaps)


def _scan_info(scans: Sequence[Scan]) -> ScanInfo | None:
    if not scans:
        return None
    classes = np.concatenate([scan.classes for scan in scans])
    spans = [float(np.ptp(s.offsets_s)) for s in scans if s.offsets_s is not None and len(s.offsets_s)]
    return ScanInfo(
        looked_at=len(scans),
        points=int(np.median([len(scan.points) for scan in scans])),
        left_out=sum(scan.left_out for scan in scans),
        labelled_scans=float(np.mean([scan.has_labels for scan in scans])),
        labelled_points=_labelled(classes),
        classes=_named(classes),
        time_span_s=float(np.median(spans)) if spans else None,
        rings=max(0 if s.rings is None or not len(s.rings) else len(np.unique(s.rings)) for s in scans),
    )


def _image_info(images: Sequence[CameraImage]) -> ImageInfo | None:
    if not images:
        return None
    classes = np.concatenate([image.mask.ravel() for image in images])
    return ImageInfo(
        looked_at=len(images),
        pictures=float(np.mean([image.has_picture for image in images])),
        masks=float(np.mean([image.has_mask for image in images])),
        labelled_pixels=_labelled(classes),
        classes=_named(classes),
    )


def _labelled(classes: NDArray[np.uint8]) -> float:
    return float(np.mean(classes != SemanticClass.IGNORE)) if classes.size else 0.0


def _named(classes: NDArray[np.uint8]) -> tuple[str, ...]:
    """Names of the classes that can be aligned."""
    present = {SemanticClass(k) for k in np.flatnonzero(np.bincount(classes, minlength=1)).tolist()}
    return tuple(c.name.lower() for c in sorted(present - {SemanticClass.OTHER, SemanticClass.IGNORE}))
