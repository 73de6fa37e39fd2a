"""What is known of one sensor's messages, for the diagnostics."""

from __future__ import annotations

from dataclasses import dataclass

from sst_graph.ros_node.published import ERROR, OK, STALE, WARN, Diagnosis

_RECENT_S = 5.0
"""An error is reported so long after it occurred."""


@dataclass
class SensorRecord:
    """Counts and times of a sensor's messages.

    Attributes:
        name: of the sensor.
        topic: it is read from.
        received, used, refused: numbers of messages.
        frame: name of its coordinate frame; empty before the first message.
        last_ns: when the last message came, by the node's clock [ns].
        error, error_ns: why the last refused message was refused, and when that was.
    """

    name: str
    topic: str
    received: int = 0
    used: int = 0
    refused: int = 0
    frame: str = ""
    last_ns: int | None = None
    error: str = ""
    error_ns: int | None = None

    def refuse(self, why: str, now_ns: int) -> None:
        """Note a message that is not used."""
        self.refused += 1
        self.error, self.error_ns = " ".join(why.split())[:300], now_ns

    def diagnosis(self, now_ns: int, silent_s: float) -> Diagnosis:
        """Silent, in error, or well."""
        values: dict[str, object] = {
            "topic": self.topic,
            "received": self.received,
            "used": self.used,
            "refused": self.refused,
            "last_error": self.error,
        }
        if self.last_ns is None:
            return Diagnosis(self.name, STALE, f"no message on {self.topic} yet", values)
        silence_s = 1e-9 * (now_ns - self.last_ns)
        if silence_s > silent_s:
            return Diagnosis(self.name, STALE, f"no message on {self.topic} for {silence_s:.1f} s", values)
        if self.error_ns is not None and 1e-9 * (now_ns - self.error_ns) < _RECENT_S:
            return Diagnosis(self.name, WARN if self.used else ERROR, self.error, values)
        return Diagnosis(self.name, OK, "messages are used" if self.used else "messages arrive", values)
