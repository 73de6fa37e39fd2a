"""The summary of a drive in lines of text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from sst_graph.data.info.summary import DriveInfo, ImageInfo, ScanInfo, SensorInfo
from sst_graph.errors import count_of

_WIDTH = 12
_GAPS = 3
"""Gaps that are named; all are counted."""
_SLOWEST_HZ = 0.1
"""A slower rate is shown as a period."""


def info_text(info: DriveInfo) -> str:
    """The summary, one fact a line."""
    return "\n".join(f"{name:<{_WIDTH}} {words}".rstrip() for name, words in _lines(info))


def _lines(info: DriveInfo) -> Iterator[tuple[str, str]]:
    yield "drive", f"{info.name}: {count_of(info.frames, 'frame')}"
    yield "camera", _camera(info.camera)
    if "lens" in info.camera:
        lens = info.camera["lens"]
        yield "", f"rectified from {_camera(lens)}, {_distortion(lens['distortion'])}"
        yield "", f"uses about {round(100 * lens['used_share'])} % of its pictures"
    for name, sensor in (("images", info.image_sensor), ("scans", info.scan_sensor)):
        yield name, _sensor(sensor)
        for gap in sorted(sensor.gaps, key=lambda one: -one.seconds)[:_GAPS]:
            yield "", f"gap of {gap.seconds:.3f} s after {_stamp(gap.from_ns)}"
    if info.images is not None:
        yield "labels", _masks(info.images)
    if info.scans is not None:
        yield "" if info.images is not None else "labels", _points(info.scans)
        yield "points", _cloud(info.scans)
    given = "yes" if info.nominal else "none"
    yield "nominal", f"{given}, {info.nominal_reason}" if info.nominal_reason else given
    for note in info.notes:
        yield "note", note
    for method, missing in info.missing.items():
        yield method, f"missing: {', '.join(missing)}" if missing else "nothing is missing"


def _camera(table: Mapping[str, Any]) -> str:
    size = f"{table['width']}x{table['height']} px"
    numbers = ", ".join(f"{name} {table[name]:.2f}" for name in ("fx", "fy", "cx", "cy"))
    return f"{table['model']}, {size}, {numbers} px"


def _distortion(values: Mapping[str, Any]) -> str:
    """Numbers of a lens: "coefficients -0.37 0.2 0.001"."""
    return ", ".join(f"{name} {' '.join(f'{v:.6g}' for v in np.ravel(values[name]))}" for name in values)


def _sensor(sensor: SensorInfo) -> str:
    parts = [f"{sensor.count} in {sensor.place}" if sensor.place else f"{sensor.count}"]
    if sensor.rate_hz is not None:
        parts.append(_rate(sensor.rate_hz))
    if sensor.first_ns is not None and sensor.last_ns is not None:
        parts.append(f"{_stamp(sensor.first_ns)} to {_stamp(sensor.last_ns)}")
    if sensor.gap_count is not None:
        parts.append(count_of(sensor.gap_count, "gap"))
    return ", ".join(parts)


def _rate(hz: float) -> str:
    """A rate; as a period, of which few sensors are, where two decimals do not show it."""
    return f"{hz:.2f} Hz" if hz >= _SLOWEST_HZ else f"one in {1.0 / hz:.4g} s (are the stamps in seconds?)"


def _masks(images: ImageInfo) -> str:
    if not images.masks:
        return "no masks"
    share, pixels = _share_of(images.masks, images.looked_at, "image"), _share(images.labelled_pixels)
    return f"masks of {share}, {pixels} of all pixels: {_classes(images.classes)}"


def _points(scans: ScanInfo) -> str:
    if not scans.labelled_scans:
        return "no labels of points"
    share, points = _share_of(scans.labelled_scans, scans.looked_at, "scan"), _share(scans.labelled_points)
    return f"labels in {share}, {points} of all points: {_classes(scans.classes)}"


def _classes(names: Sequence[str]) -> str:
    return ", ".join(names) or "none that can be aligned"


def _share_of(share: float, looked_at: int, what: str) -> str:
    """All or none of the scans or images; or how many of those that were looked at, which are few."""
    if share in (0.0, 1.0):
        return f"{_share(share)} of the {what}s"
    return f"{round(share * looked_at)} of {count_of(looked_at, what)} looked at"


def _share(share: float) -> str:
    """Per cent; of a sample, which tells all and none, and else about how many."""
    return f"{round(100 * share)} %" if share in (0.0, 1.0) else f"about {round(100 * share)} %"


def _cloud(scans: ScanInfo) -> str:
    times = "no times of points" if scans.time_span_s is None else f"times over {scans.time_span_s:.4f} s"
    rings = count_of(scans.rings, "ring") if scans.rings else "no rings"
    left_out = f", {scans.left_out} left out" if scans.left_out else ""
    return f"{scans.points} a scan{left_out}, {times}, {rings}"


def _stamp(stamp_ns: int) -> str:
    """Seconds with all nine decimals, exact."""
    seconds, nanoseconds = divmod(abs(stamp_ns), 1_000_000_000)
    return f"{'-' if stamp_ns < 0 else ''}{seconds}.{nanoseconds:09d} s"
