"""Information gained by frame, of methods other than the joint one, as stored in ``calibration.json``.

Under ``diagnostics.information_gained``: for the tracker what each scan added when it came, for the hand-eye
method what each pair of motions adds to the others. Both are less than
:mod:`sst_graph.inspect.frame_information`: no view is kept, so what to record next cannot be predicted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import gtsam
import numpy as np

from sst_graph.errors import DataError, printable
from sst_graph.graph.state import State
from sst_graph.hand_eye.graph import PRIOR_SIGMAS, state_values
from sst_graph.inspect.frame_information import MAX_NUMBER, rounded
from sst_graph.result import CalibrationResult, FrameId
from sst_graph.types import ByValue, FloatArray

KEY = "information_gained"
"""Key in the diagnostics of a result."""

Kind = Literal["as they came", "beside the others"]


@dataclass(frozen=True, eq=False)
class Gain(ByValue):
    """Information of one frame or one pair of motions. The order of seven is that of the covariance.

    Attributes:
        frame: which frame; of a pair, the image that begins it.
        bits: information on extrinsic and offset [bit]: that the covariance gained with the frame, or that
            the pair adds to all others; None where there was nothing before.
        values: (7,) sigmas after the frame [rad, m, s], or sigmas without the pair over those with it.
    """

    frame: FrameId
    bits: float | None
    values: FloatArray


@dataclass(frozen=True)
class Gained:
    """All of them, in their order; ``kind`` says what bits and values mean."""

    kind: Kind
    gains: tuple[Gain, ...]


def bits_between(before: FloatArray, after: FloatArray) -> float:
    """Information gained from one covariance (n, n) to another [bit]; negative where it grew."""
    return 0.5 * (_log_det(before) - _log_det(after)) / float(np.log(2.0))


def pair_gains(factors: Sequence[gtsam.NonlinearFactor], frames: Sequence[FrameId], state: State) -> Gained:
    """What each pair of motions adds to all others, the pairs counted as independent; factors: of each."""
    values = state_values(state)
    both = np.outer(PRIOR_SIGMAS, PRIOR_SIGMAS)
    parts = [both * factor.linearize(values).information() for factor in factors]
    total = np.eye(7) + np.sum(parts, axis=0)
    covariance, gains = np.linalg.inv(total), []
    for frame, part in zip(frames, parts, strict=True):
        without = np.linalg.inv(total - part)
        ratios = np.sqrt(np.diag(without) / np.diag(covariance))
        gains.append(Gain(frame, bits_between(without, covariance), ratios))
    return Gained("beside the others", tuple(gains))


def to_document(gained: Gained) -> dict[str, Any]:
    """JSON-able columns, four significant digits."""
    gains = gained.gains
    return {
        "kind": gained.kind,
        "drive": [gain.frame.drive for gain in gains],
        "frame": [gain.frame.frame for gain in gains],
        "bits": [rounded(gain.bits) for gain in gains],
        "values": [rounded(gain.values) for gain in gains],
    }


def gained_of(result: CalibrationResult) -> Gained | None:
    """Information gained by frame in a result, or None.

    Raises:
        DataError: the entry is there, and is not such columns.
    """
    document, place = result.diagnostics.get(KEY), f"diagnostics.{KEY}"
    if document is None:
        return None
    if not isinstance(document, Mapping) or document.get("kind") not in get_args(Kind):
        raise DataError(place, "no such object", f"kind {' or '.join(map(repr, get_args(Kind)))}")
    try:
        columns = zip(document["drive"], document["frame"], document["bits"], document["values"], strict=True)
        gains = tuple(
            Gain(
                FrameId(printable(drive), int(frame)),
                None if bits is None else float(bits),
                np.array(values, dtype=np.float64).reshape(7),
            )
            for drive, frame, bits, values in columns
        )
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(place, f"no such columns ({error})", "drive, frame, bits, values (7)") from None
    if not all((np.abs([*gain.values, gain.bits or 0.0]) <= MAX_NUMBER).all() for gain in gains):
        expected = f"finite numbers of at most {MAX_NUMBER:g}"
        raise DataError(place, "a value that is not finite, or huge", expected)
    return Gained(document["kind"], gains)


def _log_det(covariance: FloatArray) -> float:
    sigmas = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigmas, sigmas)
    return float(np.linalg.slogdet(correlation)[1] + 2.0 * np.log(sigmas).sum())
