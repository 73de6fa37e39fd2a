"""A bag: its topics, its messages in the order in which they were received, and single ones again."""

from __future__ import annotations

import errno
import struct
import weakref
from collections import deque
from collections.abc import Collection, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sst_graph.data.ros.livox import CUSTOM, OLDER_CUSTOM, custom_points
from sst_graph.errors import DataError, SstGraphError, count_of, one_line, optional_module
from sst_graph.files.reading import MAX_DIGITS, refuse_special

WHOLE_BAG = (
    "a whole ROS 1 bag, rosbag2 folder or mcap file; one that was cut short is repaired with "
    "'rosbag reindex', 'ros2 bag reindex' or 'mcap recover'"
)

TF_MESSAGE = "tf2_msgs/msg/TFMessage"
_SAME = {"tf/msg/tfMessage": TF_MESSAGE, **dict.fromkeys(OLDER_CUSTOM, CUSTOM)}
"""Names that messages have in older bags; those of transforms in bags of the first versions of ROS 1."""

_LONGEST_PROFILE = 256
_NO_PLACE = (errno.EINVAL, errno.EOVERFLOW)
"""What the system says where a damaged index points before or far behind the file."""
_KEPT = 8
"""Messages that are kept of those read last: image, mask and scan of one instant stand side by side."""
_SKIPPED_AT_MOST = 16
"""Messages that are read in passing; farther ahead the bag is searched by time."""


class Message(NamedTuple):
    """Where a message stands: its topic, the time at which it was received [ns], and its number among the
    messages of this topic and time."""

    topic: str
    received_ns: int
    occurrence: int = 0


@dataclass(frozen=True)
class Topic:
    """A topic of a bag.

    Attributes:
        name: such as "/velodyne_points".
        type: of its messages, as ROS 2 writes it: "sensor_msgs/msg/PointCloud2".
        count: number of its messages.
    """

    name: str
    type: str
    count: int


class Bag:
    """A ROS 1 bag, a rosbag2 folder, or an mcap or db3 file.

    Only the message definitions that rosbags brings are used: a bag may hold messages of any other type.
    """

    def __init__(self, path: Path) -> None:
        """Open the bag.

        Raises:
            DataError: no bag, or one that cannot be read.
            MissingDependencyError: rosbags is not installed.
        """
        self.path = path
        self._open()

    def __getstate__(self) -> Path:
        return self.path

    def __setstate__(self, path: Path) -> None:
        self.__init__(path)  # type: ignore[misc]

    def _open(self) -> None:
        self.is_ros1 = self.path.suffix == ".bag"
        without = f"{self.path}: reading bags needs rosbags, which is not installed"
        rosbags = optional_module(f"rosbags.rosbag{1 if self.is_ros1 else 2}", without, "ros")
        refuse_special([self.path, *self.path.glob("*")], "a bag")
        stack = ExitStack()
        try:
            self._reader: Any = rosbags.Reader(self.path)
            self._reader.open()
            stack.callback(_close, self._reader)
            connections = list(self._reader.connections)
            # Names and counts of a rosbag2 folder are those of its YAML, of any type.
            for one in connections:
                if (type(one.topic), type(one.msgtype), type(one.msgcount)) != (str, str, int):
                    raise ValueError(f"topic {one.topic!r:.40} of type {one.msgtype!r:.40}")
                if not 0 <= one.msgcount < 10**MAX_DIGITS:
                    raise ValueError(f"topic {one.topic!r:.40} with a count of messages that is none")
        except Exception as error:
            stack.close()
            profile = _profile(self.path)
            if profile not in ("", "ros2"):
                raise DataError(self.path, f"MCAP of profile {profile!r:.40}", "profile 'ros2'") from error
            raise _unreadable(self.path, error) from error
        weakref.finalize(self, stack.close)
        self._types = message_types(self.is_ros1)
        self._connections: dict[str, list[Any]] = {}
        for connection in connections:
            self._connections.setdefault(connection.topic, []).append(connection)
        self._stream: Iterator[tuple[Message, bytes]] | None = None
        self._streamed: frozenset[str] = frozenset()
        self._last: deque[tuple[Message, bytes]] = deque(maxlen=_KEPT)

    @property
    def topics(self) -> dict[str, Topic]:
        """Topics by name."""
        return {
            name: Topic(name, _type_of(of_topic[0]), sum(one.msgcount for one in of_topic))
            for name, of_topic in sorted(self._connections.items())
        }

    def messages(
        self, names: Collection[str], start_ns: int | None = None
    ) -> Iterator[tuple[Message, bytes]]:
        """Messages of some topics, as bytes, in the order in which they were received.

        Args:
            names: of the topics.
            start_ns: messages received before are passed over [ns].

        Raises:
            DataError: the bag is damaged.
        """
        connections = [one for name in names for one in self._connections[name]]
        seen: dict[str, Message] = {}
        try:
            for connection, received_ns, data in self._reader.messages(connections, start=start_ns):
                topic, last = connection.topic, seen.get(connection.topic)
                again = last is not None and last.received_ns == received_ns
                message = Message(topic, received_ns, last.occurrence + 1 if last and again else 0)
                seen[topic] = message
                yield message, bytes(data)
        except SstGraphError:
            raise
        except Exception as error:
            # The disk's errors stay what they are; a place in the file that is none is the bag's own.
            if isinstance(error, OSError) and error.errno not in _NO_PLACE:
                raise
            raise _unreadable(self.path, error) from error

    def read(self, message: Message, among: frozenset[str], times_ns: NDArray[np.int64]) -> bytes:
        """A message again; cheapest where messages are asked for in the order in which they were received.

        Args:
            message: from :meth:`messages`.
            among: topics that are read in turns with its own.
            times_ns: (n,) times at which the messages of these topics were received, rising.

        Raises:
            DataError: the bag is damaged, or was changed since.
        """
        if among != self._streamed:
            self._stream, self._streamed = None, among
            self._last.clear()
        for known, kept in self._last:
            if known == message:
                return kept
        if self._is_ahead(message, times_ns) and (data := self._next(message)) is not None:
            return data
        self._stream = self.messages(among, message.received_ns)
        self._last.clear()
        if (data := self._next(message)) is None:
            found = f"no message of {message.topic} received at {message.received_ns} ns"
            raise DataError(self.path, found, "the bag as it was when it was opened")
        return data

    def _next(self, message: Message) -> bytes | None:
        """A message that comes next in the stream, or soon; None where it does not come."""
        for found, data in self._stream or ():
            self._last.append((found, data))
            if found == message:
                return data
            if found.received_ns > message.received_ns:
                break
        return None

    def _is_ahead(self, message: Message, times_ns: NDArray[np.int64]) -> bool:
        """Whether a message follows closely on the one that was read last."""
        if not self._last or message.received_ns < self._last[-1][0].received_ns:
            return False
        now, then = np.searchsorted(times_ns, [self._last[-1][0].received_ns, message.received_ns])
        return int(then - now) <= _SKIPPED_AT_MOST

    def header(self, data: bytes) -> tuple[int, str]:
        """Stamp [ns] and frame of the std_msgs/Header that a message begins with.

        Raises:
            DataError: the message is shorter than that.
        """
        seconds, nanoseconds, length = self._header(data)
        frame = data[16 : 16 + length].decode("utf-8", "backslashreplace")
        return seconds * 1_000_000_000 + nanoseconds, frame.lstrip("/")

    def without_header(self, data: bytes) -> bytes:
        """What follows on the std_msgs/Header that a message begins with.

        Raises:
            DataError: the message is shorter than that.
        """
        return data[16 + self._header(data)[2] :]

    def _header(self, data: bytes) -> tuple[int, int, int]:
        """Seconds, nanoseconds and length of the frame's name."""
        try:
            if self.is_ros1:
                _, seconds, nanoseconds, length = struct.unpack_from("<IIII", data, 0)
            else:
                order = "<" if data[1] & 1 else ">"
                seconds, nanoseconds, length = struct.unpack_from(f"{order}iII", data, 4)
                length = max(length - 1, 0)
        except (struct.error, IndexError):
            raise DataError(
                self.path, f"a message of {count_of(len(data), 'byte')}", "a std_msgs/Header"
            ) from None
        return seconds, nanoseconds, length

    def decoded(self, data: bytes, type_name: str) -> Any:
        """A message with its fields as attributes; of Livox's CustomMsg the points, by field.

        Raises:
            DataError: the bytes hold no message of this type.
        """
        if type_name == CUSTOM:
            at = 16 + self._header(data)[2] + (not self.is_ros1)
            return custom_points(data, at, self.is_ros1, f"{self.path}, {CUSTOM}")
        try:
            if self.is_ros1:
                return self._types.deserialize_ros1(data, type_name)
            return self._types.deserialize_cdr(data, type_name)
        except Exception as error:
            raise _unreadable(self.path, error) from error


def _type_of(connection: Any) -> str:
    """Type of a topic's messages, by the newest of its names."""
    name = str(connection.msgtype)
    return _SAME.get(name, name)


def message_types(is_ros1: bool) -> Any:
    """Definitions of the messages, a typestore of rosbags."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    if TF_MESSAGE not in types.fielddefs:
        types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF_MESSAGE))
    return types


def _profile(path: Path) -> str:
    """Profile in the header of an MCAP file, which says whose messages it holds; empty where none does.

    A header is the file's first record: magic (8 bytes), opcode 1, length of the record (8) and of the
    profile's name (4).
    """
    try:
        with open(path, "rb") as stream:
            start = stream.read(_LONGEST_PROFILE)
    except OSError:
        return ""
    if not start.startswith(b"\x89MCAP") or len(start) < 21:
        return ""
    (length,) = struct.unpack_from("<I", start, 17)
    return start[21 : 21 + length].decode("utf-8", "replace")


def _close(reader: Any) -> None:
    # A reader that failed while it was opened has closed itself.
    with suppress(Exception):
        reader.close()


def _unreadable(path: Path, error: Exception) -> DataError:
    """What rosbags and the decoders below it raise on damaged bytes has no common root.

    What Python says of a missing entry or one of another type would mean nothing to a reader of the message.
    """
    python_says = isinstance(
        error.__cause__ or error, (LookupError, TypeError, AttributeError, AssertionError)
    )
    why = "entries of it are missing or of another type" if python_says else one_line(error)
    return DataError(path, f"a bag that cannot be read ({why})", WHOLE_BAG)
