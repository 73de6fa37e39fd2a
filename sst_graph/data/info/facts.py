"""What a source may tell of itself beside its frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray


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


@runtime_checkable
class FactsReader(Protocol):
    """A source that tells what it holds; of others a few frames are looked at."""

    def facts(self) -> SourceFacts:
        """Sensors and their stamps; no frame is read."""
        ...
