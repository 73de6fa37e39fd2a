"""A further camera of a drive whose scans are prepared: only its images are read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sst_graph.data.frame_parts import (
    NumberedFrames,
    image_at,
    image_positions,
    number_at,
    scan_at,
    scan_positions,
)
from sst_graph.drive.input_statistics import InputStatistics, StatisticsCollector
from sst_graph.drive.preparation import (
    Drive,
    ImageFeatures,
    LeftOut,
    PrepareConfig,
    Progress,
    ScanFeatures,
    image_features,
)
from sst_graph.errors import DataError, count_of
from sst_graph.files.array_store import ArrayStore, replaced
from sst_graph.odometry.features import FeatureTracker
from sst_graph.odometry.sweep import SweptSource
from sst_graph.odometry.visual import ImagePair, next_pair
from sst_graph.types import Frame, SemanticClass, Source
from sst_graph.validation import checked_image


def with_camera(
    drive: Drive,
    source: Source,
    classes: Sequence[SemanticClass],
    config: PrepareConfig,
    progress: Progress | None,
) -> Drive:
    """The drive with the images of another camera; its scans, motions and sweep are shared.

    Args:
        source: of the other camera, with the same scans.

    Raises:
        DataError: other scans than the drive's, no image, or arrays that are not what they must be.
    """
    numbers = _scan_numbers(drive, source)
    images, pairs, left_out, seen = _images(source, classes, config, progress)
    if not images:
        raise DataError(source.name, f"no image in {count_of(len(source), 'frame')}", "scans and images")
    scans = tuple(replaced(scan, index=number) for scan, number in zip(drive.scans, numbers, strict=True))
    for_scans = drive.left_out
    left_out = replace(
        left_out,
        points=for_scans.points,
        scans_with_such_points=for_scans.scans_with_such_points,
        scans_without_labels=for_scans.scans_without_labels,
    )
    return replace(
        drive,
        name=source.name,
        camera=source.camera,
        scans=scans,
        images=tuple(images),
        image_pairs=tuple(pairs),
        left_out=left_out,
        statistics=_statistics(drive, scans, seen),
        origin_ns=None,
        frames=_frames(drive, source),
    )


def _images(
    source: Source, classes: Sequence[SemanticClass], config: PrepareConfig, progress: Progress | None
) -> tuple[list[ImageFeatures], list[ImagePair], LeftOut, InputStatistics]:
    """Features of all images, tracks between them where the settings need them, and what was found."""
    positions = image_positions(source)
    collector, left_out, store = (
        StatisticsCollector(len(positions)),
        LeftOut(),
        ArrayStore(config.in_memory_bytes),
    )
    tracker, images, pairs = FeatureTracker(), [], []
    for done, position in enumerate(positions):
        image, index = image_at(source, position), number_at(source, position)
        if progress is not None:
            progress(f"reading {source.name}", done + 1, len(positions))
        if image is None:
            continue
        image = checked_image(image, source.camera, f"{source.name}, frame {index}")
        frame = Frame(index, None, image)
        left_out.add(frame)
        collector.add(frame)
        if config.use_visual_odometry:
            pair = next_pair(tracker, image, source.camera, config.track_interval_s)
            if pair is not None:
                pairs.append(pair)
        images.append(image_features(index, image, classes, config.image_edges).stored_in(store))
    return images, pairs, left_out, collector.statistics()


def _frames(drive: Drive, source: Source) -> NumberedFrames:
    """The other camera's frames, their scans with the sweep of the drive."""
    swept = source if drive.sweep is None else SweptSource(source, drive.sweep)
    return NumberedFrames(swept, {number_at(source, p): p for p in range(len(source))})


def _scan_numbers(drive: Drive, source: Source) -> list[int]:
    """Number of the frame of each scan in the other camera's source.

    Raises:
        DataError: the source has other scans.
    """
    positions = [p for p in scan_positions(source)]
    numbers = [number_at(source, position) for position in positions]
    if len(numbers) > len(drive.scans):
        known = {scan.index for scan in drive.scans}
        kept = [(p, n) for p, n in zip(positions, numbers, strict=True) if n in known]
        positions, numbers = [p for p, _ in kept], [n for _, n in kept]
    expected = f"the {count_of(len(drive.scans), 'scan')} of {drive.name}, as the first camera has them"
    if len(numbers) != len(drive.scans):
        raise DataError(source.name, count_of(len(numbers), "scan"), expected)
    for at in (0, -1):
        scan = scan_at(source, positions[at])
        if scan is None or scan.stamp_ns != drive.scans[at].stamp_ns:
            found = "none" if scan is None else f"{scan.stamp_ns} ns"
            raise DataError(f"{source.name}, frame {numbers[at]}", f"a scan stamped {found}", expected)
    return numbers


def _statistics(
    drive: Drive, scans: Sequence[ScanFeatures], of_images: InputStatistics
) -> InputStatistics | None:
    """Statistics of the drive's scans, by the other source's numbers, and of the other camera's images."""
    if drive.statistics is None:
        return None
    number = {old.index: new.index for old, new in zip(drive.scans, scans, strict=True)}
    of_scans = tuple(replace(s, index=number.get(s.index, s.index)) for s in drive.statistics.scans)
    return InputStatistics(of_scans, of_images.images)
