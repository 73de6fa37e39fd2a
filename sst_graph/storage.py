"""Objects of this package as JSON and bytes, and back: what refers to one thing still does.

Plain values, containers, arrays, poses and instances of the package's own classes can be stored; the latter
by their attributes, or by ``__getstate__`` and ``__setstate__`` where a class has them. Reading imports
nothing, and calls no constructor and no other code of theirs than these two, whatever the bytes say.
"""

from __future__ import annotations

import dataclasses
import enum
import sys
import zlib
from collections import deque
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, Literal, TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Node = Any
"""A plain value, or [tag, ...]."""

_Order = Literal["C", "F"]
_Kept = TypeVar("_Kept")

_PACKAGES = ("sst_graph.", "factors.")
_SEQUENCES = (tuple, list, set, frozenset)
_PLAIN = (bool, int, float, str, type(None))
_COMPRESSED_BYTES = 65_536
"""Masks of this size or more are compressed."""


def stored(value: object) -> tuple[Node, bytes]:
    """A value as JSON (with NaN and Infinity) and the bytes of its arrays.

    Raises:
        TypeError: something in it cannot be stored.
    """
    writer = _Writer()
    node = writer.node(value)
    return node, b"".join(writer.parts)


def restored(node: Node, data: bytes | memoryview) -> Any:
    """The value behind :func:`stored`.

    Raises:
        ValueError: it is not one, or one of classes that have changed since.
    """
    try:
        return _Reader(memoryview(data)).value(node)
    except (ArithmeticError, AttributeError, LookupError, TypeError, zlib.error) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error


class _Writer:
    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self._end = 0
        self._known: dict[int, tuple[int, object]] = {}  # the object too, so that its id is not used again

    def node(self, value: object) -> Node:
        if type(value) in _PLAIN:
            return value
        if isinstance(value, enum.Enum):
            return ["enum", _name(type(value)), value.value]
        if isinstance(value, np.generic):
            return ["scalar", value.dtype.str, self._bytes(value.tobytes())]
        if id(value) in self._known:
            return ["same", self._known[id(value)][0]]
        number = len(self._known)
        self._known[id(value)] = (number, value)
        return [*self._parts_of(value), number]

    def _parts_of(self, value: object) -> list[Node]:
        if isinstance(value, np.ndarray):
            return self._array(value)
        if isinstance(value, set | frozenset):
            # In an order that does not depend on how it came to be.
            return [type(value).__name__, [self.node(one) for one in sorted(value, key=repr)]]
        if isinstance(value, _SEQUENCES) and type(value) in _SEQUENCES:
            return [type(value).__name__, [self.node(one) for one in value]]
        if isinstance(value, deque):
            return ["deque", [self.node(one) for one in value], value.maxlen]
        if type(value) is dict:
            return ["dict", [[self.node(key), self.node(one)] for key, one in value.items()]]
        if isinstance(value, gtsam.Pose3):
            return ["pose", self.node(np.asarray(value.matrix()))]
        if isinstance(value, cKDTree):
            return ["tree", self.node(np.asarray(value.data))]
        name = _name(type(value))
        if not name.startswith(_PACKAGES):
            raise TypeError(f"found a {name}, expected plain values, arrays and classes of the package")
        return ["object", name, self.node(_state(value))]

    def _array(self, array: NDArray[Any]) -> list[Node]:
        if array.dtype.hasobject:
            raise TypeError("found an array of objects, expected one of numbers")
        order: _Order = "F" if array.flags.f_contiguous and not array.flags.c_contiguous else "C"
        data = array.tobytes(order)
        packed = array.dtype == np.uint8 and len(data) >= _COMPRESSED_BYTES
        place = self._bytes(zlib.compress(data, 1) if packed else data)
        return ["array", array.dtype.str, list(array.shape), order, packed, place]

    def _bytes(self, data: bytes) -> list[int]:
        start, self._end = self._end, self._end + len(data)
        self.parts.append(data)
        return [start, len(data)]


class _Reader:
    def __init__(self, data: memoryview) -> None:
        self._data = data
        self._known: dict[int, Any] = {}

    def value(self, node: Node) -> Any:
        if not isinstance(node, list):
            return node
        if node[0] == "same":
            return self._known[node[1]]
        if node[0] == "enum":
            return _class(node[1])(node[2])
        if node[0] == "scalar":
            return np.frombuffer(self._bytes(node[2]), np.dtype(node[1]))[0]
        read: Callable[..., Any] = getattr(self, f"_{node[0]}")
        return read(*node[1:])

    def _keep(self, number: int, value: _Kept) -> _Kept:
        self._known[number] = value
        return value

    def _array(
        self, dtype: str, shape: list[int], order: str, packed: bool, place: list[int], number: int
    ) -> NDArray[Any]:
        data = self._bytes(place)
        flat = np.frombuffer(zlib.decompress(data) if packed else data, np.dtype(dtype)).copy()
        return self._keep(number, flat.reshape(shape, order="F" if order == "F" else "C"))

    def _tuple(self, nodes: list[Node], number: int) -> tuple[Any, ...]:
        return self._keep(number, tuple(self.value(node) for node in nodes))

    def _frozenset(self, nodes: list[Node], number: int) -> frozenset[Any]:
        return self._keep(number, frozenset(self.value(node) for node in nodes))

    def _list(self, nodes: list[Node], number: int) -> list[Any]:
        found: list[Any] = self._keep(number, [])
        found.extend(self.value(node) for node in nodes)
        return found

    def _set(self, nodes: list[Node], number: int) -> set[Any]:
        found: set[Any] = self._keep(number, set())
        found.update(self.value(node) for node in nodes)
        return found

    def _deque(self, nodes: list[Node], most: int | None, number: int) -> deque[Any]:
        found: deque[Any] = self._keep(number, deque(maxlen=most))
        found.extend(self.value(node) for node in nodes)
        return found

    def _dict(self, nodes: list[list[Node]], number: int) -> dict[Any, Any]:
        found: dict[Any, Any] = self._keep(number, {})
        for key, node in nodes:
            found[self.value(key)] = self.value(node)
        return found

    def _pose(self, node: Node, number: int) -> gtsam.Pose3:
        return self._keep(number, gtsam.Pose3(self.value(node)))

    def _tree(self, node: Node, number: int) -> cKDTree:
        # What is found does not depend on its shape.
        return self._keep(number, cKDTree(self.value(node), balanced_tree=False, compact_nodes=False))

    def _object(self, name: str, node: Node, number: int) -> Any:
        cls = _class(name)
        value: Any = self._keep(number, object.__new__(cls))
        state = self.value(node)
        if "__setstate__" in dir(cls):
            value.__setstate__(state)
            return value
        if dataclasses.is_dataclass(cls) and {f.name for f in dataclasses.fields(cls)} != set(state):
            raise ValueError(f"other attributes of {name}: {', '.join(sorted(state))}")
        for attribute, one in state.items():
            object.__setattr__(value, attribute, one)
        return value

    def _bytes(self, place: list[int]) -> memoryview:
        start, length = place
        if not 0 <= start <= start + length <= len(self._data):
            raise ValueError(f"bytes {start} to {start + length} of {len(self._data)}")
        return self._data[start : start + length]


def _state(value: object) -> Mapping[str, Any]:
    """Attributes of an object, without what it computed from them."""
    if type(value).__getstate__ is not object.__getstate__:
        state: Mapping[str, Any] = value.__getstate__()  # type: ignore[assignment]
        return state
    if dataclasses.is_dataclass(value):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    return {
        name: one
        for name, one in vars(value).items()
        if not isinstance(getattr(type(value), name, None), cached_property)
    }


def _name(cls: type) -> str:
    return f"{cls.__module__}:{cls.__qualname__}"


def _class(name: str) -> type:
    """The class of a name, if it is one of the package's, in a module that is there already."""
    module, _, path = name.partition(":")
    if not name.startswith(_PACKAGES) or module not in sys.modules:
        raise ValueError(f"a class {name}")
    found: Any = sys.modules[module]
    for part in path.split("."):
        found = getattr(found, part)
    if not isinstance(found, type) or _name(found) != name:
        raise ValueError(f"a class {name}")
    return found
