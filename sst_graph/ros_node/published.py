"""What the node publishes, as messages of rosbags."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sst_graph.data.ros.messages import MessageMaker
from sst_graph.tracker.track_update import TrackUpdate, unconfirmed_sentences

DIAGNOSTICS, STRING = "diagnostic_msgs/msg/DiagnosticArray", "std_msgs/msg/String"
OK, WARN, ERROR, STALE = range(4)
"""Levels of a DiagnosticStatus."""

_LEVELS = {"ok": OK, "contradicted": ERROR, "alarm": ERROR}
"""Of the tracker's status; all others are warnings."""


@dataclass(frozen=True)
class Published:
    """Messages that are due; None where there is nothing to say.

    Attributes:
        status: std_msgs/String with the line of JSON that ``sst-graph track`` prints for a frame.
        transforms: tf2_msgs/TFMessage with the calibration.
        diagnostics: diagnostic_msgs/DiagnosticArray.
    """

    status: Any = None
    transforms: Any = None
    diagnostics: Any = None


@dataclass(frozen=True)
class Diagnosis:
    """A DiagnosticStatus without its name's prefix."""

    name: str
    level: int
    message: str
    values: Mapping[str, object]


class NodeMessages(MessageMaker):
    """Makes the messages of ROS 2 that the node publishes.

    Args:
        node_name: what the names of the diagnostics begin with.
    """

    def __init__(self, node_name: str) -> None:
        super().__init__()
        self.node_name = node_name

    def status(self, update: TrackUpdate) -> Any:
        """String of an update."""
        return self.make(STRING, data=json.dumps(update.to_dict(), allow_nan=False))

    def diagnostics(self, found: list[Diagnosis], stamp_ns: int) -> Any:
        """DiagnosticArray; hardware_id is left empty."""
        statuses = [
            self.make(
                "diagnostic_msgs/msg/DiagnosticStatus",
                level=one.level,
                name=f"{self.node_name}: {one.name}",
                message=one.message,
                hardware_id="",
                values=[
                    self.make("diagnostic_msgs/msg/KeyValue", key=key, value=str(value))
                    for key, value in one.values.items()
                ],
            )
            for one in found
        ]
        return self.make(DIAGNOSTICS, header=self.header(stamp_ns, ""), status=statuses)


def diagnosis_of(update: TrackUpdate) -> Diagnosis:
    """The calibration's diagnosis: status, sigmas, offset."""
    words = [update.status, update.reason, *unconfirmed_sentences(update), *update.contradictions]
    words.append(update.undecided_sweep)
    words += [weak.sentence for weak in update.weak_directions[:1]]
    sigmas = update.sigmas
    values: dict[str, object] = {
        "status": update.status,
        "time_offset_s": f"{update.time_offset_s:.6f}",
        "sigma_rotation_rad": " ".join(f"{value:.3g}" for value in sigmas[:3]),
        "sigma_translation_m": " ".join(f"{value:.3g}" for value in sigmas[3:6]),
        "sigma_time_offset_s": f"{sigmas[6]:.3g}",
        "matches": update.matches,
        "chi2": "" if update.chi2 is None else f"{update.chi2:.3g}",
        "unconfirmed_s": f"{update.unconfirmed_s:.2f}",
    }
    message = "; ".join(word for word in words if word)
    return Diagnosis("calibration", _LEVELS.get(update.status, WARN), message, values)
