"""The unknowns that the outer loop estimates, and their keys in the graph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import gtsam
import numpy as np

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.types import Calibration, FloatArray, SemanticClass

EXTRINSIC = gtsam.symbol("E", 0)
"""Key of the extrinsic cTl (Pose3)."""

_IMAGES_PER_DRIVE = 10_000_000
"""Keys of the images of two drives, and of their objects, are this far apart; a key has 56 bits for them."""
_Key = TypeVar("_Key")


def time_offset_key(clock: int = 0) -> int:
    """Key of the time offset of a clock (``Vector(1)``); drives share clock 0 unless each has its own."""
    return int(gtsam.symbol("D", clock))


def twist_key(drive: int, image: int) -> int:
    """Key of the camera's twist at an image (``Vector(6)``)."""
    return int(gtsam.symbol("V", drive * _IMAGES_PER_DRIVE + image))


def bias_key(drive: int, semantic_class: SemanticClass) -> int:
    """Key of the mask bias of a class in a drive (``Vector(1)``, px)."""
    return int(gtsam.symbol("B", drive * 256 + int(semantic_class)))


def lower_edge_track(semantic_class: SemanticClass) -> int:
    """Track number of the lower edges of a class, which share one mask bias."""
    return _IMAGES_PER_DRIVE - 256 + int(semantic_class)


def object_bias_key(drive: int, track: int) -> int:
    """Key of the mask bias of one object, by its track (``Vector(1)``, px)."""
    return int(gtsam.symbol("O", drive * _IMAGES_PER_DRIVE + track))


def nuisance_key(name: str) -> int:
    """Key of the parameter of an assumption that is estimated (``Vector(1)``)."""
    return int(gtsam.symbol("N", list(ASSUMPTIONS).index(name)))


@dataclass(frozen=True)
class State:
    """The current estimate.

    Attributes:
        cTl: extrinsic.
        time_offsets_s: time offset of each clock [s].
        biases_px: mask bias by (drive, class) [px]; 0 where it is missing.
        object_biases_px: mask bias by (drive, track of an object) [px]; its class's where it is missing.
        nuisances: values of the assumptions' parameters, by name; 0 where it is missing.
    """

    cTl: gtsam.Pose3
    time_offsets_s: tuple[float, ...] = (0.0,)
    biases_px: Mapping[tuple[int, SemanticClass], float] = field(default_factory=dict)
    object_biases_px: Mapping[tuple[int, int], float] = field(default_factory=dict)
    nuisances: Mapping[str, float] = field(default_factory=dict)

    def clock(self, drive: int) -> int:
        """Number of the clock that a drive's time offset belongs to."""
        return drive if len(self.time_offsets_s) > 1 else 0

    def time_offset_s(self, drive: int) -> float:
        """Time offset of a drive [s]."""
        return self.time_offsets_s[self.clock(drive)]

    def calibration(self, drive: int = 0) -> Calibration:
        """Extrinsic and time offset of a drive."""
        return Calibration(self.cTl, self.time_offset_s(drive))

    def object_bias_px(self, drive: int, track: int, semantic_class: SemanticClass) -> float:
        """Mask bias of one object [px]."""
        of_class = self.biases_px.get((drive, semantic_class), 0.0)
        return self.object_biases_px.get((drive, track), of_class)

    def biases_of(self, drive: int) -> dict[SemanticClass, float]:
        """Mask biases of a drive by class [px]."""
        return {c: bias for (d, c), bias in self.biases_px.items() if d == drive}

    def of_drive(self, drive: int) -> State:
        """Extrinsic and the time offset of a drive, without anything else."""
        return State(self.cTl, (self.time_offset_s(drive),))

    def later(self, seconds: float) -> State:
        """The state with all time offsets moved by so much [s]."""
        return replace(self, time_offsets_s=tuple(offset_s + seconds for offset_s in self.time_offsets_s))

    def moved(self, step: FloatArray) -> State:
        """Extrinsic and first time offset a step (7,) away, without anything else."""
        return State(self.cTl.retract(step[:6]), (self.time_offsets_s[0] + float(step[6]),))

    def with_parameters(self, names: Sequence[str]) -> State:
        """The state with further parameters of assumptions, at zero."""
        return replace(self, nuisances={**self.nuisances, **dict.fromkeys(names, 0.0)})

    def towards(self, other: State, share: float) -> State:
        """Interpolation from this state (share 0) to another one (1), which has all of this one's biases."""
        if share >= 1.0:
            return other
        step = share * gtsam.Pose3.Logmap(self.cTl.between(other.cTl))
        return State(
            self.cTl.compose(gtsam.Pose3.Expmap(step)),
            tuple(
                a + share * (b - a) for a, b in zip(self.time_offsets_s, other.time_offsets_s, strict=True)
            ),
            _interpolated(self.biases_px, other.biases_px, share),
            _interpolated(self.object_biases_px, other.object_biases_px, share),
            _interpolated(self.nuisances, other.nuisances, share),
        )


def difference(a: State, b: State) -> FloatArray:
    """(7,) step from one state to another, of extrinsic and first time offset, in the tangent space of the
    covariance."""
    return a.calibration().local_coordinates(b.calibration())


def step_text(step: FloatArray) -> str:
    """A step (7,) [rad, m, s] in a sentence: "0.10 deg, 1.2 cm and +3.4 ms"."""
    rotation, translation = np.linalg.norm(step[:3]), np.linalg.norm(step[3:6])
    return f"{np.degrees(rotation):.2f} deg, {100.0 * translation:.1f} cm and {1e3 * step[6]:+.1f} ms"


def _interpolated(a: Mapping[_Key, float], b: Mapping[_Key, float], share: float) -> dict[_Key, float]:
    """From a (share 0) to b (1); what a does not have is as in b."""
    return {key: (1.0 - share) * a.get(key, value) + share * value for key, value in b.items()}
