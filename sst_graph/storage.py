"""Objects of this package as JSON and bytes, and back: what refers to one thing still does.

Plain values, containers, arrays, poses and instances of the package's own classes can be stored; the latter
by their attributes, or by ``__getstate__`` and ``__setstate__`` where a class has them.

Reading trusts nothing. A node's tag is looked up in a fixed table, and a class's or an enumeration's name in
the table that the caller gives: no name in the bytes is imported, called or looked up as an attribute. No
constructor is called; what a class checks of itself (``__post_init__``) and how it takes its state
(``__setstate__``) is the only code of theirs that runs. Fields have the declared types. Arrays hold plain
numbers, their bytes are there or unpack to what their shape says, and all together stay below a limit that is
checked before memory is taken.
"""

from __future__ import annotations

import dataclasses
import enum
import math
import zlib
from collections import deque
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, Literal, TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sst_graph.typed import wrong_fields

Node = Any
"""A plain value, or [tag, ...]."""

_Order = Literal["C", "F"]
_Kept = TypeVar("_Kept")

_PACKAGES = ("sst_graph.", "factors.")
_SEQUENCES = (tuple, list, set, frozenset)
_PLAIN = (bool, int, float, str, type(None))
_COMPRESSED_BYTES = 65_536
"""Masks of this size or more are compressed."""

MAX_ARRAY_BYTES = 512 * 1024 * 1024
"""Of all arrays together: sixty masks and pictures' edges of eight million pixels."""

_DTYPES = frozenset(["|b1", "|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f4", "<f8"])
_MAX_DIMENSIONS = 8
_ROTATION_TOLERANCE = 1e-6
"""Of a pose that was a pose when it was written: R R' - I."""

Classes = Mapping[str, type]
"""Classes and enumerations that may be read, by :func:`class_name`."""


@dataclasses.dataclass(frozen=True)
class PackedArray:
    """An array of bytes that is compressed already, and stored as it is; it comes back as an array.

    Attributes:
        shape: of the array.
        data: its bytes in C order, compressed by zlib.
    """

    shape: tuple[int, ...]
    data: bytes

    @staticmethod
    def of(array: NDArray[np.uint8]) -> PackedArray:
        """Compress an array; equal ones give equal bytes."""
        return PackedArray(array.shape, zlib.compress(array.tobytes(), 1))

    def array(self) -> NDArray[np.uint8]:
        """The array."""
        return np.frombuffer(zlib.decompress(self.data), np.uint8).reshape(self.shape)


def stored(value: object, classes: Classes | None = None) -> tuple[Node, bytes]:
    """A value as JSON (with NaN and Infinity as text) and the bytes of its arrays.

    Args:
        classes: the only ones that may be in it; None: any of the package.

    Raises:
        TypeError: something in it cannot be stored.
    """
    writer = _Writer(classes)
    node = writer.node(value)
    return node, b"".join(writer.parts)


def restored(node: Node, data: bytes | memoryview, classes: Classes) -> Any:
    """The value behind :func:`stored`.

    Args:
        classes: the only ones that may be in it, by :func:`class_name`.

    Raises:
        ValueError: it is not one, or one of classes that have changed since.
    """
    try:
        return _Reader(memoryview(data), classes).value(node)
    except (
        ArithmeticError,
        AssertionError,
        AttributeError,
        LookupError,
        MemoryError,
        RecursionError,
        RuntimeError,
        TypeError,
        zlib.error,
    ) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error


def lay_out(root: object) -> None:
    """Give the arrays in an object the memory layout, and its sets the order, that they are read back with.

    How NumPy rounds depends on the layout: only so what was stored and what is read back go on alike, to the
    last bit.
    """
    known: dict[int, tuple[object, object]] = {}  # the object too, so that its id is not used again

    def laid_out(value: object) -> object:
        if isinstance(value, (*_PLAIN, enum.Enum)):
            return value
        if id(value) not in known:
            known[id(value)] = (value, value)
            known[id(value)] = (value, _laid_out(value, laid_out))
        return known[id(value)][1]

    laid_out(root)


def _laid_out(value: Any, part: Callable[[Any], Any]) -> Any:
    """A value with its parts laid out, in place where that goes."""
    if isinstance(value, np.ndarray):
        dense = value.flags.c_contiguous or value.flags.f_contiguous
        return value if dense else np.ascontiguousarray(value)
    if type(value) is tuple:
        parts = tuple(part(one) for one in value)
        return value if all(a is b for a, b in zip(parts, value, strict=True)) else parts
    if type(value) is set:
        ordered = sorted(value, key=repr)
        value.clear()
        value.update(ordered)
    elif isinstance(value, list | deque):
        for place, one in enumerate(value):
            value[place] = part(one)
    elif type(value) is dict:
        for key, one in value.items():
            value[key] = part(one)
    elif class_name(type(value)).startswith(_PACKAGES):
        attributes = vars(value) if hasattr(value, "__dict__") else {}
        for name, one in _state(value).items():
            # What is stored otherwise than it is kept is made anew when it is read.
            if attributes.get(name) is one and part(one) is not one:
                object.__setattr__(value, name, part(one))
    return value


def class_name(cls: type) -> str:
    """The name under which a class or an enumeration is stored: "module:name"."""
    return f"{cls.__module__}:{cls.__qualname__}"


class _Writer:
    def __init__(self, classes: Classes | None) -> None:
        self.parts: list[bytes] = []
        self._classes = classes
        self._end = 0
        self._known: dict[int, tuple[int, object]] = {}  # the object too, so that its id is not used again

    def node(self, value: object) -> Node:
        if type(value) is float and not math.isfinite(value):
            return ["float", repr(value)]
        if type(value) in _PLAIN:
            return value
        if isinstance(value, enum.Enum):
            return ["enum", self._name(type(value)), value.value]
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
        if isinstance(value, PackedArray):
            return ["array", "|u1", list(value.shape), "C", True, self._bytes(value.data)]
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
        return ["object", self._name(type(value)), self.node(_state(value))]

    def _name(self, cls: type) -> str:
        name = class_name(cls)
        if not name.startswith(_PACKAGES) or (self._classes is not None and name not in self._classes):
            raise TypeError(f"found a {name}, expected plain values, arrays and classes of the package")
        return name

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
    def __init__(self, data: memoryview, classes: Classes) -> None:
        self._data = data
        self._classes = classes
        self._known: dict[int, Any] = {}
        self._array_bytes = 0
        self._readers: dict[str, Callable[..., Any]] = {
            "same": self._same,
            "enum": self._enum,
            "float": self._float,
            "scalar": self._scalar,
            "array": self._array,
            "tuple": self._tuple,
            "frozenset": self._frozenset,
            "list": self._list,
            "set": self._set,
            "deque": self._deque,
            "dict": self._dict,
            "pose": self._pose,
            "tree": self._tree,
            "object": self._object,
        }

    def value(self, node: Node) -> Any:
        if not isinstance(node, list):
            if type(node) not in _PLAIN:
                raise ValueError(f"a JSON {type(node).__name__}")
            return node
        if not node or not isinstance(node[0], str) or node[0] not in self._readers:
            raise ValueError(f"an unknown tag {node[:1]!r:.60}")
        return self._readers[node[0]](*node[1:])

    def _keep(self, number: int, value: _Kept) -> _Kept:
        if type(number) is not int or number in self._known:
            raise ValueError(f"the number {number!r:.60} twice, or none")
        self._known[number] = value
        return value

    def _same(self, number: int) -> Any:
        return self._known[number]

    def _enum(self, name: str, value: Any) -> enum.Enum:
        cls = self._class(name)
        if not issubclass(cls, enum.Enum):
            raise ValueError(f"an enumeration {name:.60}")
        members = [member for member in cls if type(member.value) is type(value) and member.value == value]
        if len(members) != 1:
            raise ValueError(f"{value!r:.60} of {name}")
        return members[0]

    def _float(self, text: str) -> float:
        return {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}[text]

    def _scalar(self, dtype: str, place: list[int]) -> Any:
        (value,) = np.frombuffer(self._bytes(place), self._dtype(dtype))
        return value

    def _dtype(self, name: str) -> np.dtype[Any]:
        if name not in _DTYPES:
            raise ValueError(f"numbers of type {name!r:.60}")
        return np.dtype(name)

    def _array(
        self, dtype: str, shape: list[int], order: str, packed: bool, place: list[int], number: int
    ) -> NDArray[Any]:
        kind = self._dtype(dtype)
        if len(shape) > _MAX_DIMENSIONS or not all(type(n) is int and n >= 0 for n in shape):
            raise ValueError(f"an array of shape {shape!r:.60}")
        size = math.prod(shape) * kind.itemsize
        self._array_bytes += size
        if self._array_bytes > MAX_ARRAY_BYTES:
            raise ValueError(f"arrays of more than {MAX_ARRAY_BYTES} bytes")
        data: bytes | memoryview = self._bytes(place)
        if packed:
            data = zlib.decompressobj().decompress(data, size + 1)
        if len(data) != size:
            raise ValueError(f"{len(data)} bytes of an array of {size}")
        flat = np.frombuffer(data, kind).copy()
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
        if most is not None and not (type(most) is int and len(nodes) <= most):
            raise ValueError(f"{len(nodes)} entries of at most {most!r:.60}")
        found: deque[Any] = self._keep(number, deque(maxlen=most))
        found.extend(self.value(node) for node in nodes)
        return found

    def _dict(self, nodes: list[list[Node]], number: int) -> dict[Any, Any]:
        found: dict[Any, Any] = self._keep(number, {})
        for key, node in nodes:
            found[self.value(key)] = self.value(node)
        return found

    def _pose(self, node: Node, number: int) -> gtsam.Pose3:
        T = self.value(node)
        if not (isinstance(T, np.ndarray) and T.shape == (4, 4) and np.isfinite(T).all()):
            raise ValueError("a pose that is no finite 4x4 matrix")
        R = np.clip(T[:3, :3], -2.0, 2.0)  # so that the product does not overflow
        if np.abs(R @ R.T - np.eye(3)).max() > _ROTATION_TOLERANCE or np.linalg.det(R) < 0.0:
            raise ValueError("a pose whose rotation is none")
        if (T[3] != (0.0, 0.0, 0.0, 1.0)).any():
            raise ValueError(f"a pose with the last row {T[3].tolist()}")
        return self._keep(number, gtsam.Pose3(T))

    def _tree(self, node: Node, number: int) -> cKDTree:
        points = self.value(node)
        if not (isinstance(points, np.ndarray) and points.ndim == 2 and np.isfinite(points).all()):
            raise ValueError("a tree of what are no finite points")
        # What is found does not depend on its shape.
        return self._keep(number, cKDTree(points, balanced_tree=False, compact_nodes=False))

    def _object(self, name: str, node: Node, number: int) -> Any:
        cls = self._class(name)
        if issubclass(cls, enum.Enum):
            raise ValueError(f"an object {name}")
        value: Any = self._keep(number, object.__new__(cls))
        state = self.value(node)
        if not isinstance(state, dict) or not all(isinstance(key, str) for key in state):
            raise ValueError(f"a state of {name} that is no table")
        if "__setstate__" in dir(cls):
            value.__setstate__(state)
        else:
            self._fill(value, cls, state)
        if dataclasses.is_dataclass(cls):
            _check_dataclass(value, name)
        return value

    def _fill(self, value: Any, cls: type, state: dict[str, Any]) -> None:
        if dataclasses.is_dataclass(cls) and {f.name for f in dataclasses.fields(cls)} != set(state):
            raise ValueError(f"other attributes of {class_name(cls)}: {', '.join(sorted(state)):.200}")
        for attribute, one in state.items():
            # Nothing of the class itself may be hidden; a field with a default is an attribute of it.
            own = hasattr(cls, attribute) and not dataclasses.is_dataclass(cls)
            if own or attribute.startswith("__") or not attribute.isidentifier():
                raise ValueError(f"an attribute {attribute!r:.60} of {class_name(cls)}")
            object.__setattr__(value, attribute, one)

    def _class(self, name: str) -> type:
        if not isinstance(name, str) or name not in self._classes:
            raise ValueError(f"a class {name!r:.100}")
        return self._classes[name]

    def _bytes(self, place: list[int]) -> memoryview:
        start, length = place
        whole = type(start) is int and type(length) is int
        if not whole or not 0 <= start <= start + length <= len(self._data):
            raise ValueError(f"bytes {start!r:.30} and {length!r:.30} more of {len(self._data)}")
        return self._data[start : start + length]


def _check_dataclass(value: Any, name: str) -> None:
    """Fields of the declared types, and what the class itself asks of them."""
    wrong = wrong_fields(value)
    if wrong:
        found = type(getattr(value, wrong[0])).__name__
        raise ValueError(f"a {found} as {wrong[0]} of {name}")
    check = getattr(type(value), "__post_init__", None)
    if check is not None:
        check(value)


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
