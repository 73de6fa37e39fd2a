"""What is known of one sensor's messages, for the diagnostics."""

from __future__ import annotations

from dataclasses import dataclass

from sst_graph.errors import count_of
from sst_graph.ros_node.published import ERROR, OK, STALE, WARN, Diagnosis

_RECENT_S = 5.0
"""An error, or a loss, is reported so long after it occurred."""


@dataclass
class SensorRecord:
    """Counts and times of a sensor's messages.

    Attributes:
        name: of the sensor.
        topic: it is read from.
        type_name: of its messages, "sensor_msgs/msg/Image".
        received, used, refused: numbers of messages.
        frame: name of its coordinate frame; empty before the first message.
        last_ns: when the last message came, by the node's clock [ns].
        error, error_ns: why the last refused message was refused, and when that was.
        lost, lost_ns: messages that the network lost, as the middleware counts them, and when the last was.
        waited_s: longest that a message since the last diagnosis had waited before it was taken [s].
        published: types that the topic is published as; None where this is not known.
    """

    name: str
    topic: str
    type_name: str = ""
    received: int = 0
    used: int = 0
    refused: int = 0
    frame: str = ""
    last_ns: int | None = None
    error: str = ""
    error_ns: int | None = None
    lost: int = 0
    lost_ns: int | None = None
    waited_s: float = 0.0
    published: frozenset[str] | None = None
    _diagnosed: int = 0

    @property
    def missing(self) -> str:
        """A sentence that says that there was no message, and why, where that is known."""
        why = ""
        if self.published is not None and self.type_name not in self.published:
            why = ": nothing publishes it"
            if self.published:
                why = f": it is published as {', '.join(sorted(self.published))}, not {self.type_name}"
        return f"no message on {self.topic} yet{why}"

    def refuse(self, why: str, now_ns: int) -> None:
        """Note a message that is not used."""
        self.refused += 1
        self.error, self.error_ns = " ".join(why.split())[:300], now_ns

    def has_recent_error(self, now_ns: int) -> bool:
        """Whether a message was refused a short time ago."""
        return _recent(self.error_ns, now_ns)

    def lose(self, count: int, now_ns: int) -> None:
        """Note messages that the network lost."""
        self.lost += count
        self.lost_ns = now_ns

    def wait(self, seconds: float) -> None:
        """Note how long a message waited before it was taken."""
        self.waited_s = max(self.waited_s, seconds)

    def diagnosis(self, now_ns: int, silent_s: float) -> Diagnosis:
        """Silent, in error, or well.

        Not silent is a sensor of which a message was taken since the last diagnosis: a node that was busy for
        long has taken none of those that wait.
        """
        taken, self._diagnosed, self.waited_s = self.received > self._diagnosed, self.received, 0.0
        values: dict[str, object] = {
            "topic": self.topic,
            "received": self.received,
            "used": self.used,
            "refused": self.refused,
            "lost": self.lost,
            "last_error": self.error,
        }
        if self.last_ns is None:
            return Diagnosis(self.name, STALE, self.missing, values)
        silence_s = 1e-9 * (now_ns - self.last_ns)
        if silence_s > silent_s and not taken:
            return Diagnosis(self.name, STALE, f"no message on {self.topic} for {silence_s:.1f} s", values)
        if self.has_recent_error(now_ns):
            return Diagnosis(self.name, WARN if self.used else ERROR, self.error, values)
        if _recent(self.lost_ns, now_ns):
            words = f"{count_of(self.lost, 'message')} lost by the network"
            return Diagnosis(self.name, WARN, words, values)
        return Diagnosis(self.name, OK, "messages are used" if self.used else "messages arrive", values)


def _recent(then_ns: int | None, now_ns: int) -> bool:
    """Whether that was a short time ago; what a clock that was set back puts into the future was not."""
    return then_ns is not None and 0 <= now_ns - then_ns < 1e9 * _RECENT_S
