"""What a source may tell of itself beside its frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
    """

    scan: SensorFacts
    image: SensorFacts
    nominal: str = ""
    notes: tuple[str, ...] = ()


def facts_of(source: Source) -> SourceFacts | None:
    """Sensors and their stamps, where a source, or the one that it is a view of, has a method ``facts``; no
    frame is read. Of other sources a few frames are looked at.
    """
    reader = getattr(source, "facts", None)
    return reader() if callable(reader) else None
