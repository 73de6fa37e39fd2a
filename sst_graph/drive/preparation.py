"""Preparation of a drive in one pass: boundary points, contours, a sample of points, motion."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from sst_graph.config import Settings, internal
from sst_graph.data.frame_parts import NumberedFrames
from sst_graph.drive.geometric_labels import labelled_by_geometry
from sst_graph.drive.input_statistics import InputStatistics, StatisticsCollector
from sst_graph.errors import DataError, count_of
from sst_graph.factors.arguments import checked_callback
from sst_graph.factors.camera import PinholeCamera
from sst_graph.features.lidar_edges import MAX_RANGE_M, Boundaries, Edge, find_boundaries, with_points
from sst_graph.features.mask_contour import ContourMap
from sst_graph.features.picture_gradients import PictureGradients
from sst_graph.files.array_store import IN_MEMORY_BYTES, ArrayStore, replaced, storable
from sst_graph.files.object_store import PackedArray
from sst_graph.odometry.features import FeatureTracker
from sst_graph.odometry.lidar import LidarOdometry, LidarOdometryConfig
from sst_graph.odometry.sweep import SweepDecision, SweptSource
from sst_graph.odometry.visual import ImagePair, next_pair
from sst_graph.sampling import step_for
from sst_graph.types import CameraImage, FloatArray, Frame, RelativeMotion, Scan, SemanticClass, Source
from sst_graph.validation import checked_frame, checked_image, checked_scan

_LOG = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]
"""Called with (stage, steps done, steps in all)."""


def check_progress(progress: object) -> None:
    """Refuse what cannot be called as a :data:`Progress`; None is none.

    Raises:
        FactorError: it cannot.
    """
    checked_callback("progress", progress, ("stage", "done", "total"))


SAMPLE_POINTS = 3000
"""Most labelled points of a scan that are kept for search and checks, of each class."""
_SAMPLE_NEAR_M, _FAR_M = 2.0, 60.0
"""Ranges between which points are kept [m]."""
TRACK_INTERVAL_S = 0.07
"""Shortest motion of the camera that is compared with the LiDAR's [s]: the rotation between two images is
known as well after 33 ms as after 100 ms, the rate of turn is not."""
DENSE_SHARE = 0.8
"""Images are dense where their period is a smaller share of the scans' than this: stamps of equal rates
differ by some per cent."""
_DEPTH_POINTS = 30_000
"""Points of a scan that are kept for the depth of image features, about."""


@dataclass(frozen=True)
class PrepareConfig(Settings):
    """What is kept of every frame.

    Attributes:
        max_range_m: range beyond which objects are not used [m].
        image_edges: move the contours of the masks to the edges in the picture.
        lidar_odometry: motion between scans.
        use_visual_odometry: track image features for the motion of the camera.
        in_memory_bytes: of what is kept, the rest lies in a temporary file.
        track_interval_s: images that follow a tracked one sooner are not tracked [s].
    """

    max_range_m: float = internal(MAX_RANGE_M)
    image_edges: bool = internal(True)
    lidar_odometry: LidarOdometryConfig = field(default_factory=LidarOdometryConfig)
    use_visual_odometry: bool = internal(True)
    in_memory_bytes: int = internal(IN_MEMORY_BYTES)
    track_interval_s: float = internal(0.0)


@storable("lPs", "classes", "offsets_s", "depth_lPs", "depth_offsets_s")
@dataclass(frozen=True)
class ScanFeatures:
    """Features of a scan.

    Attributes:
        index: of its frame in the drive.
        stamp_ns: LiDAR-clock stamp.
        boundaries: boundary points of each class, without those towards the ground.
        lPs, classes, offsets_s: (n, 3), (n,), (n,) a sample of its labelled points [m], [s].
        depth_lPs, depth_offsets_s: points for depth of image features (all classes); none where image
            features are not tracked [m], [s].
        lower_edges: boundary points of each class towards the ground, of objects that have others too.
        by_geometry: of a scan with labels, where objects without a class were looked for too, the same scan
            by these alone.
    """

    stored_apart: ClassVar[bool] = True

    index: int
    stamp_ns: int
    boundaries: dict[SemanticClass, Boundaries]
    lPs: FloatArray
    classes: NDArray[np.uint8]
    offsets_s: FloatArray
    depth_lPs: NDArray[np.float32]
    depth_offsets_s: NDArray[np.float32]
    lower_edges: dict[SemanticClass, Boundaries] = field(default_factory=dict)
    by_geometry: ScanFeatures | None = None

    def stored_in(self, store: ArrayStore) -> ScanFeatures:
        """The scan with its points in an array store, the sample in the precision of the scan's."""
        boundaries, lower_edges = (
            {c: points.stored_in(store) for c, points in found.items()}
            for found in (self.boundaries, self.lower_edges)
        )
        return replace(
            self,
            boundaries=boundaries,
            lower_edges=lower_edges,
            lPs=store.put(self.lPs.astype(np.float32), np.float64),
            classes=store.put(self.classes),
            offsets_s=store.put(self.offsets_s.astype(np.float32), np.float64),
            depth_lPs=store.put(self.depth_lPs),
            depth_offsets_s=store.put(self.depth_offsets_s),
            by_geometry=None if self.by_geometry is None else self.by_geometry.stored_in(store),
        )


@storable("mask")
@dataclass(frozen=True)
class ImageFeatures:
    """Features of an image: its mask and the signed distance to each class's contour.

    Of the picture, only its edges along the contours are kept; its gradients, too, where objects without a
    class are aligned.
    """

    stored_apart: ClassVar[bool] = True

    index: int
    stamp_ns: int
    mask: NDArray[np.uint8]
    contours: dict[SemanticClass, ContourMap | PictureGradients]

    def stored_in(self, store: ArrayStore) -> ImageFeatures:
        """The image with mask and distances in an array store."""
        contours = {c: contour.stored_in(store) for c, contour in self.contours.items()}
        return replace(self, mask=store.put(self.mask), contours=contours)

    def with_contours(self, contours: dict[SemanticClass, ContourMap | PictureGradients]) -> ImageFeatures:
        """The image with other contours."""
        return replaced(self, contours=contours)

    def __getstate__(self) -> dict[str, Any]:
        """The mask, packed, and the picture's edges, not the distances that follow from them."""
        edges = {
            c: contour.edges if isinstance(contour, ContourMap) else contour
            for c, contour in self.contours.items()
        }
        maps = (contour for contour in self.contours.values() if isinstance(contour, ContourMap))
        stretch = next((contour.stretch for contour in maps), None)
        return {
            "index": self.index,
            "stamp_ns": self.stamp_ns,
            "mask": self.packed,
            "contours": edges,
            "stretch": stretch,
        }

    @cached_property
    def packed(self) -> PackedArray:
        """The mask, compressed once: that takes longer than all else of storing an image."""
        return PackedArray.of(self.mask)

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        mask, stretch = state["mask"], state.get("stretch")
        if isinstance(mask, PackedArray):
            mask = mask.array()
        fields = {
            c: edges
            if isinstance(edges, PictureGradients)
            else ContourMap.of(mask, c, edges=edges, stretch=stretch)
            for c, edges in state["contours"].items()
        }
        contours = {c: field for c, field in fields.items() if field is not None}
        values = {"index": state["index"], "stamp_ns": state["stamp_ns"], "mask": mask, "contours": contours}
        for name, value in values.items():
            object.__setattr__(self, name, value)


@dataclass
class LeftOut:
    """Counts of what a drive lacked; the rest of it was used.

    Attributes:
        points: that were NaN, inf or at the origin.
        scans_with_such_points: scans that held some.
        scans_without_labels: these show motion only.
        images_without_mask: nothing is associated with these.
        images_without_picture: these have no image features, and contours that follow the mask alone.
    """

    points: int = 0
    scans_with_such_points: int = 0
    scans_without_labels: int = 0
    images_without_mask: int = 0
    images_without_picture: int = 0

    def add(self, frame: Frame) -> None:
        """Count what a frame lacks; a scan without points lacks nothing."""
        if frame.scan is not None:
            self.points += frame.scan.left_out
            self.scans_with_such_points += frame.scan.left_out > 0
            self.scans_without_labels += len(frame.scan.points) > 0 and not frame.scan.has_labels
        if frame.image is not None:
            self.images_without_mask += not frame.image.has_mask
            self.images_without_picture += not frame.image.has_picture

    def counts(self) -> dict[str, int]:
        """What was found missing at least once, by name."""
        return {name: int(count) for name, count in vars(self).items() if count}

    def in_part(self, scans: int, images: int) -> LeftOut:
        """Without labels that no scan has, and masks that no image has: such a drive has none."""
        return replace(
            self,
            scans_without_labels=self.scans_without_labels if self.scans_without_labels < scans else 0,
            images_without_mask=self.images_without_mask if self.images_without_mask < images else 0,
        )

    def __str__(self) -> str:
        found = []
        for name, count in self.counts().items():
            what, *without = name.split("_")
            found.append(" ".join([count_of(count, what.removesuffix("s")), *without]))
        return ", ".join(found)


@dataclass(frozen=True)
class Drive:
    """A drive, reduced to what calibration needs.

    Attributes:
        name: of the source.
        camera: of all images.
        scans, images: in the order of their stamps.
        lidar_motions: between consecutive scans; empty for a single scan.
        image_pairs: tracks between consecutive images that are tracked; empty for a single one.
        left_out: what the data lacked.
        statistics: of the raw frames, for the search for causes; None where they were not collected.
        sweep: decision about the times of the points; None where there was none.
        origin_ns: stamp of an image from which assumptions about clocks count time; None: the first one's.
        labelled_ns: stamps of the scans and of the images whose labels are aligned. Objects without a class
            are not matched between two of these.
        frames: where they can be read again; None: tests that need more than is kept are left out.
    """

    name: str
    camera: PinholeCamera
    scans: tuple[ScanFeatures, ...]
    images: tuple[ImageFeatures, ...]
    lidar_motions: tuple[RelativeMotion, ...]
    image_pairs: tuple[ImagePair, ...]
    left_out: LeftOut = field(default_factory=LeftOut)
    statistics: InputStatistics | None = None
    sweep: SweepDecision | None = None
    origin_ns: int | None = None
    labelled_ns: tuple[frozenset[int], frozenset[int]] = (frozenset(), frozenset())
    frames: NumberedFrames | None = None

    def have_labels(self, scan: int, image: int) -> bool:
        """Whether a scan and an image, by position, both have labels that are aligned."""
        scans, images = self.labelled_ns
        return self.scans[scan].stamp_ns in scans and self.images[image].stamp_ns in images

    @property
    def scan_stamps_ns(self) -> list[int]:
        return [scan.stamp_ns for scan in self.scans]

    @property
    def image_stamps_ns(self) -> list[int]:
        return [image.stamp_ns for image in self.images]

    @cached_property
    def image_period_s(self) -> float:
        """Median interval between images [s]; 0.1 for a single one."""
        stamps = self.image_stamps_ns
        return float(np.median(np.diff(stamps))) * 1e-9 if len(stamps) > 1 else 0.1

    def part(self, scans: Sequence[int]) -> Drive:
        """The drive with some of its scans only, by position, rising; all images and motions stay."""
        return replace(self, scans=tuple(self.scans[position] for position in scans))

    @cached_property
    def has_dense_images(self) -> bool:
        """Whether there are clearly more images than scans."""
        return self.image_period_s < DENSE_SHARE * self.lidar_period_s

    @cached_property
    def lidar_period_s(self) -> float:
        """As :attr:`scan_period_s`, but a part of a drive has that of the whole one [s]."""
        spans_ns = [motion.to_ns - motion.from_ns for motion in self.lidar_motions]
        return 1e-9 * float(np.median(spans_ns)) if spans_ns else self.scan_period_s

    @cached_property
    def scan_period_s(self) -> float:
        """Median interval between scans [s]; 0.1 for a single one."""
        stamps = self.scan_stamps_ns
        return float(np.median(np.diff(stamps))) * 1e-9 if len(stamps) > 1 else 0.1


def prepare_drive(
    source: Source,
    classes: Sequence[SemanticClass],
    config: PrepareConfig | None = None,
    progress: Progress | None = None,
    depth: bool = True,
    with_lower_edges: bool = True,
) -> Drive:
    """Read every frame of a source once and keep what calibration needs, most of it in an array store.

    Args:
        depth: keep points for the depth of image features, where these are tracked.
        with_lower_edges: find edges towards the ground.

    Raises:
        DataError: the source has no scan or no image, its stamps do not rise, or the arrays of one are not
            what they must be (:mod:`sst_graph.validation`).
    """
    config = config or PrepareConfig()
    odometry = LidarOdometry(config.lidar_odometry)
    tracker = FeatureTracker()
    scans, images, motions, pairs = [], [], [], []
    positions: dict[int, int] = {}
    total = len(source)
    left_out, collector, store = LeftOut(), StatisticsCollector(total), ArrayStore(config.in_memory_bytes)
    for position, frame in enumerate(source):
        frame = _checked(frame, source.camera, source.name, position)
        positions[frame.index] = position
        left_out.add(frame)
        collector.add(frame)
        if frame.scan is not None:
            motion = odometry.add(frame.scan)
            if motion is not None:
                motions.append(motion)
            features = scan_features(frame.index, frame.scan, classes, config, depth, with_lower_edges)
            scans.append(features.stored_in(store))
        if frame.image is not None:
            if config.use_visual_odometry:
                pair = next_pair(tracker, frame.image, source.camera, config.track_interval_s)
                if pair is not None:
                    pairs.append(pair)
            contours = image_features(frame.index, frame.image, classes, config.image_edges)
            images.append(contours.stored_in(store))
        if progress is not None:
            progress(f"reading {source.name}", position + 1, total)
    if not scans or not images:
        missing = "scan" if not scans else "image"
        raise DataError(source.name, f"no {missing} in {count_of(total, 'frame')}", "scans and images")
    if left_out.counts():
        surprising = left_out.in_part(len(scans), len(images)).counts()
        _LOG.log(logging.WARNING if surprising else logging.INFO, "%s: left out: %s", source.name, left_out)
    sweep = source.sweep_decision if isinstance(source, SweptSource) else None
    return Drive(
        source.name,
        source.camera,
        tuple(scans),
        tuple(images),
        tuple(motions),
        tuple(pairs),
        left_out,
        collector.statistics(),
        sweep,
        frames=NumberedFrames(source, positions),
    )


def _checked(frame: object, camera: PinholeCamera, drive: str, position: int) -> Frame:
    """The frame with checked arrays; odometry bridges a scan without points."""
    frame = checked_frame(frame, f"{drive}, frame at position {position}")
    place = f"{drive}, frame {frame.index}"
    scan = None if frame.scan is None else checked_scan(frame.scan, place, fewest=0)
    image = None if frame.image is None else checked_image(frame.image, camera, place)
    return Frame(frame.index, scan, image)


def scan_features(
    index: int,
    scan: Scan,
    classes: Sequence[SemanticClass],
    config: PrepareConfig,
    depth: bool = True,
    with_lower_edges: bool = True,
) -> ScanFeatures:
    """Boundaries of a scan and a sample of its points; the arguments are those of :func:`prepare_drive`.

    Objects without a class are found by geometry where ``classes`` has them and the scan does not.
    """
    if SemanticClass.OBJECT in classes and not (scan.classes == int(SemanticClass.OBJECT)).any():
        named = [c for c in classes if c != SemanticClass.OBJECT]
        objects = labelled_by_geometry(scan)
        some = (SemanticClass.OBJECT,) if (objects.classes == int(SemanticClass.OBJECT)).any() else ()
        by_geometry = scan_features(index, objects, some, config, depth, False)
        if not named or not scan.has_labels:
            return by_geometry
        by_labels = scan_features(index, scan, named, config, depth, with_lower_edges)
        return replace(by_labels, by_geometry=by_geometry)
    offsets = np.zeros(len(scan.points), np.float32) if scan.offsets_s is None else scan.offsets_s
    chosen = _sample(scan)
    deep = np.zeros(0, dtype=np.intp)
    if depth and config.use_visual_odometry:
        near = np.flatnonzero(np.linalg.norm(scan.points, axis=1) < _FAR_M)
        deep = near[:: max(1, len(scan.points) // _DEPTH_POINTS)]
    boundaries, lower_edges = apart(find_boundaries(scan, classes, config.max_range_m, with_lower_edges))
    return ScanFeatures(
        index,
        scan.stamp_ns,
        boundaries,
        scan.points[chosen].astype(np.float64),
        scan.classes[chosen],
        offsets[chosen].astype(np.float64),
        scan.points[deep],
        offsets[deep],
        lower_edges,
    )


def apart(
    found: dict[SemanticClass, Boundaries],
) -> tuple[dict[SemanticClass, Boundaries], dict[SemanticClass, Boundaries]]:
    """Boundary points without those towards the ground, and those towards the ground."""
    boundaries, lower_edges = {}, {}
    for c, points in found.items():
        down = points.edges == Edge.BOTTOM
        boundaries[c] = points.take(np.flatnonzero(~down))
        known = np.isin(points.objects, boundaries[c].objects)
        lower_edges[c] = points.take(np.flatnonzero(down & known))
    return with_points(boundaries), with_points(lower_edges)


def boundaries_of(
    scan: ScanFeatures, lower_edges: Collection[SemanticClass]
) -> dict[SemanticClass, Boundaries]:
    """A scan's boundary points, of some classes with those towards the ground."""
    some = {c: scan.lower_edges[c] for c in lower_edges if c in scan.lower_edges}
    return {c: points.joined(some[c]) if c in some else points for c, points in scan.boundaries.items()}


def boundary_count(scan: ScanFeatures, lower_edges: Collection[SemanticClass]) -> int:
    """Number of the points of :func:`boundaries_of`."""
    below = sum(len(points) for c, points in scan.lower_edges.items() if c in lower_edges)
    return below + sum(map(len, scan.boundaries.values()))


def _sample(scan: Scan) -> NDArray[np.intp]:
    """Evenly spread indices of at most ``SAMPLE_POINTS`` points of every known class, 2 to 60 m away."""
    square = np.einsum("ij,ij->i", scan.points, scan.points)
    usable = (square > _SAMPLE_NEAR_M**2) & (square < _FAR_M**2) & (scan.classes != SemanticClass.IGNORE)
    parts = [np.zeros(0, dtype=np.intp)]
    # Compared with plain ints: compared with NumPy's, all classes are converted to int64.
    for c in np.flatnonzero(np.bincount(scan.classes[usable])).tolist():
        members = np.flatnonzero(usable & (scan.classes == c))
        parts.append(members[:: step_for(len(members), SAMPLE_POINTS)])
    return np.concatenate(parts)


def image_features(
    index: int, image: CameraImage, classes: Sequence[SemanticClass], use_picture: bool = True
) -> ImageFeatures:
    """Mask and contours of an image; ``use_picture``: the contours follow its picture.

    The mask is a copy: the image's arrays may be filled anew, as a driver's are.
    """
    picture = image.pixels if use_picture else None
    fields = {
        c: ContourMap.of(image.mask, c, picture, valid=image.valid, stretch=image.stretch)
        for c in classes
        if c != SemanticClass.OBJECT
    }
    contours: dict[SemanticClass, ContourMap | PictureGradients] = {
        c: field for c, field in fields.items() if field is not None
    }
    if SemanticClass.OBJECT in classes and image.has_picture:
        contours[SemanticClass.OBJECT] = PictureGradients.of(image.pixels, image.valid)
    return ImageFeatures(index, image.stamp_ns, image.mask.copy(), contours)
