"""What a source may tell of itself beside its frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sst_graph.data.frame_parts import image_at, image_positions, scan_at, scan_positions
from sst_graph.data.source_view import SourceView
from sst_graph.timestamps import Span
from sst_graph.types import Source


@dataclass(frozen=True, eq=False)
class SensorFacts:
    """A sensor of a drive.

    Attributes:
        place: where its data stand: a topic, a folder.
        stamps_ns: (n,) stamps of all its messages or files, in its own clock, rising [ns].
        topic: name of the topic; empty where it is none.
    """

    place: str
    stamps_ns: NDArray[np.int64]
    topic: str = ""


@dataclass(frozen=True, eq=False)
class SourceFacts:
    """What a drive says of itself.

    Attributes:
        scan, image: the LiDAR and the camera.
        nominal: where the nominal extrinsic comes from, or why there is none.
        notes: sentences on what else was found.
        remarks: such that concern every result of the drive.
        doubts: what may be wrong with the data: reasons of a result that is not ok, behind causes that are
            found.
    """

    scan: SensorFacts
    image: SensorFacts
    nominal: str = ""
    notes: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()


def facts_of(source: Source) -> SourceFacts | None:
    """Sensors and their stamps, where a source, or the one that it is a view of, has a method ``facts``; no
    frame is read. Of other sources a few frames are looked at.
    """
    reader = getattr(source, "facts", None)
    if not callable(reader) and isinstance(source, SourceView):
        return facts_of(source.source)
    return reader() if callable(reader) else None


def spans_of(source: Source) -> tuple[Span, Span] | None:
    """First and last stamp of the scans and of the images; None where a sensor has no frame.

    Raises:
        DataError: one of them cannot be read.
    """
    facts = facts_of(source)
    if facts is not None:
        scans, images = facts.scan.stamps_ns.tolist(), facts.image.stamps_ns.tolist()
    else:
        of_scans, of_images = _ends(scan_positions(source)), _ends(image_positions(source))
        scans = [scan.stamp_ns for k in of_scans if (scan := scan_at(source, k)) is not None]
        images = [image.stamp_ns for k in of_images if (image := image_at(source, k)) is not None]
    return ((scans[0], scans[-1]), (images[0], images[-1])) if scans and images else None


def _ends(positions: Sequence[int]) -> list[int]:
    return [positions[0], positions[-1]] if positions else []
