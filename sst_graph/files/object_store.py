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
import json
import math
import zlib
from collections import deque
from collections.abc import Callable, Container, Mapping, Sequence
from functools import cache, cached_property
from typing import Any, Literal, TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sst_graph.errors import count_of
from sst_graph.factors.arguments import rotation_error
from sst_graph.files.typed_values import wrong_fields

Node = Any
"""A plain value, or [tag, ...]."""

_Order = Literal["C", "F"]
_Kept = TypeVar("_Kept")

_PACKAGES = ("sst_graph.",)
_PLAIN = frozenset([bool, int, float, str, type(None)])
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


_KINDS: dict[type, str] = {
    PackedArray: "packed",
    set: "set",
    frozenset: "set",
    tuple: "sequence",
    list: "sequence",
    deque: "deque",
    dict: "dict",
}
"""How values of just these classes are stored."""
_FAMILIES: tuple[tuple[type, str], ...] = (
    (enum.Enum, "enum"),
    (np.generic, "scalar"),
    (np.ndarray, "array"),
    (gtsam.Pose3, "pose"),
    (gtsam.Rot3, "rotation"),
    (cKDTree, "tree"),
)
"""How values of these classes, and of those derived from them, are stored; all others by their attributes."""


@cache
def _kind(cls: Any) -> str:
    """How a value of a class is stored."""
    return _KINDS.get(cls) or next((kind for family, kind in _FAMILIES if issubclass(cls, family)), "object")


@dataclasses.dataclass(frozen=True)
class Block:
    """A value that never changes, stored once.

    Attributes:
        number: by which others refer to it; above those that it refers to.
        value: itself, so that its id is not used again.
        text: its node, as JSON.
        data: the bytes of its arrays.
        within: numbers of the blocks that it refers to.
    """

    number: int
    value: object
    text: str
    data: bytes
    within: frozenset[int]


class Blocks:
    """Values that never change, each stored once however often what refers to them is stored.

    These are the instances of classes with ``stored_apart = True``.
    """

    def __init__(self, classes: Classes | None = None) -> None:
        """classes: the only ones that may be in them; None: any of the package."""
        self.classes = classes
        self._blocks: dict[int, Block] = {}
        self._next = 0

    def __contains__(self, value_id: object) -> bool:
        """Whether the value of an id is one of them."""
        return value_id in self._blocks

    def number(self, value: object) -> int:
        """The number of a value, which is stored if it has not been yet.

        Raises:
            TypeError: something in it cannot be stored.
        """
        block = self._blocks.get(id(value))
        if block is None:
            lay_out(value, self)
            writer = _Writer(self.classes, self)
            # What it refers to is stored first, and has lower numbers.
            node = [*writer.parts_of(value), 0]
            data, within = b"".join(writer.parts), frozenset(writer.referred)
            block = Block(self._next, value, json.dumps(node, allow_nan=False), data, within)
            self._blocks[id(value)] = block
            self._next += 1
        return block.number

    def stored(self, value: object) -> tuple[Node, bytes, list[Block]]:
        """As :func:`stored`, with the blocks that it refers to, by rising number; the others are forgotten.

        Raises:
            TypeError: something in it cannot be stored.
        """
        writer = _Writer(self.classes, self)
        node = writer.node(value)
        used, kept = set(writer.referred), []
        for block in reversed(self._blocks.values()):
            if block.number in used:
                used |= block.within
                kept.append(block)
        kept.reverse()
        self._blocks = {id(block.value): block for block in kept}
        return node, b"".join(writer.parts), kept


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


def restored(node: Node, data: bytes | memoryview, classes: Classes, blocks: Sequence[Node] = ()) -> Any:
    """The value behind :func:`stored`, or behind :meth:`Blocks.stored`.

    Args:
        classes: the only ones that may be in it, by :func:`class_name`.
        blocks: [number, start of its bytes in ``data``, how many, node] of each block it may refer to; blocks
            refer to earlier ones.

    Raises:
        ValueError: it is not one, or one of classes that have changed since.
    """
    try:
        reader = _Reader(memoryview(data), classes)
        for number, start, length, block in blocks:
            reader.take_block(number, [start, length], block)
        return reader.value(node)
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


def attribute_node(node: Node, name: str) -> Node:
    """The node of one attribute of a stored object; the first one refers to nothing beside it.

    Raises:
        ValueError: no object, or one without it.
    """
    match node:
        case ["object", str(), ["dict", list(attributes), *_], *_]:
            for each in attributes:
                if isinstance(each, list) and len(each) == 2 and each[0] == name:
                    return each[1]
    raise ValueError(f"no object with {name}")


def lay_out(root: object, done: Container[int] = ()) -> None:
    """Give the arrays in an object the memory layout, and its sets the order, that they are read back with.

    How NumPy rounds depends on the layout: only so what was stored and what is read back go on alike, to the
    last bit.

    Args:
        done: ids of values that need not be looked at.
    """
    known: dict[int, tuple[object, object]] = {}  # the object too, so that its id is not used again

    def laid_out(value: object) -> object:
        if type(value) in _PLAIN or id(value) in done:
            return value
        if id(value) not in known:
            known[id(value)] = (value, value)
            known[id(value)] = (value, _laid_out(value, laid_out))
        return known[id(value)][1]

    laid_out(root)


def _laid_out(value: Any, part: Callable[[Any], Any]) -> Any:
    """A value with its parts laid out, in place where that goes."""
    cls: Any = type(value)
    kind = _kind(cls)
    if kind == "array":
        dense = value.flags.c_contiguous or value.flags.f_contiguous
        return value if dense else np.ascontiguousarray(value)
    if type(value) is tuple:
        parts = tuple(part(one) for one in value)
        return value if all(a is b for a, b in zip(parts, value, strict=True)) else parts
    if type(value) is set:
        ordered = sorted(value, key=repr)
        value.clear()
        value.update(ordered)
    elif kind in ("sequence", "deque"):
        for place, one in enumerate(value):
            value[place] = part(one)
    elif kind == "dict":
        for key, one in value.items():
            value[key] = part(one)
    elif kind == "object" and class_name(type(value)).startswith(_PACKAGES):
        attributes = vars(value) if hasattr(value, "__dict__") else {}
        for name, one in _state(value).items():
            # Only attributes that are stored as they are: others are derived again when the object is read.
            if attributes.get(name) is one and part(one) is not one:
                object.__setattr__(value, name, part(one))
    return value


def class_name(cls: type) -> str:
    """The name under which a class or an enumeration is stored: "module:name"."""
    return f"{cls.__module__}:{cls.__qualname__}"


class _Writer:
    def __init__(self, classes: Classes | None, blocks: Blocks | None = None) -> None:
        self.parts: list[bytes] = []
        self.referred: set[int] = set()
        self._classes, self._blocks = classes, blocks
        self._end = 0
        self._known: dict[int, tuple[int, object]] = {}  # the object too, so that its id is not used again

    def node(self, value: Any) -> Node:
        cls: Any = type(value)
        if cls in _PLAIN:
            return ["float", repr(value)] if cls is float and not math.isfinite(value) else value
        kind = _kind(cls)
        if kind == "enum":
            return ["enum", self._name(cls), value.value]
        if kind == "scalar":
            return ["scalar", value.dtype.str, self._bytes(value.tobytes())]
        known = self._known.get(id(value))
        if known is not None:
            return ["same", known[0]]
        if self._blocks is not None and getattr(cls, "stored_apart", False):
            block = self._blocks.number(value)
            self.referred.add(block)
            return ["block", block]
        number = len(self._known)
        return [*self.parts_of(value), number]

    def parts_of(self, value: object) -> list[Node]:
        """A value's node but for its number, the next one."""
        self._known[id(value)] = (len(self._known), value)
        cls: Any = type(value)
        parts: list[Node] = getattr(self, f"_{_kind(cls)}")(value)
        return parts

    def _packed(self, value: PackedArray) -> list[Node]:
        return ["array", "|u1", list(value.shape), "C", True, self._bytes(value.data)]

    def _set(self, value: set[Any] | frozenset[Any]) -> list[Node]:
        # In an order that does not depend on how it came to be.
        return [type(value).__name__, [self.node(one) for one in sorted(value, key=repr)]]

    def _sequence(self, value: list[Any] | tuple[Any, ...]) -> list[Node]:
        return [type(value).__name__, [self.node(one) for one in value]]

    def _deque(self, value: deque[Any]) -> list[Node]:
        return ["deque", [self.node(one) for one in value], value.maxlen]

    def _dict(self, value: dict[Any, Any]) -> list[Node]:
        return ["dict", [[self.node(key), self.node(one)] for key, one in value.items()]]

    def _pose(self, value: gtsam.Pose3) -> list[Node]:
        return ["pose", self.node(np.asarray(value.matrix()))]

    def _rotation(self, value: gtsam.Rot3) -> list[Node]:
        return ["rotation", self.node(np.asarray(value.matrix()))]

    def _tree(self, value: cKDTree) -> list[Node]:
        return ["tree", self.node(np.asarray(value.data))]

    def _object(self, value: object) -> list[Node]:
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
        self._blocks: dict[int, Any] = {}
        self._array_bytes = 0
        self._readers: dict[str, Callable[..., Any]] = {
            "same": self._same,
            "block": self._block,
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
            "rotation": self._rotation,
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

    def take_block(self, number: int, place: list[int], node: Node) -> None:
        """Read a block: its numbers and its bytes are its own."""
        if type(number) is not int or number in self._blocks:
            raise ValueError(f"the block {number!r:.60} twice, or none")
        whole, self._data = self._data, self._bytes(place)
        self._blocks[number] = self.value(node)
        self._data, self._known = whole, {}

    def _block(self, number: int) -> Any:
        return self._blocks[number]

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
            raise ValueError(f"{count_of(len(data), 'byte')} of an array of {size}")
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
            raise ValueError(f"{count_of(len(nodes), 'entry', 'entries')} of at most {most!r:.60}")
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
        if not _is_rotation(T[:3, :3]):
            raise ValueError("a pose whose rotation is none")
        if (T[3] != (0.0, 0.0, 0.0, 1.0)).any():
            raise ValueError(f"a pose with the last row {T[3].tolist()}")
        return self._keep(number, gtsam.Pose3(T))

    def _rotation(self, node: Node, number: int) -> gtsam.Rot3:
        R = self.value(node)
        if not (isinstance(R, np.ndarray) and R.shape == (3, 3) and np.isfinite(R).all() and _is_rotation(R)):
            raise ValueError("a rotation that is none")
        return self._keep(number, gtsam.Rot3(R))

    def _tree(self, node: Node, number: int) -> cKDTree:
        points = self.value(node)
        if not (isinstance(points, np.ndarray) and points.ndim == 2 and np.isfinite(points).all()):
            raise ValueError("a tree of what are no finite points")
        # A query's answer does not depend on how the tree is balanced.
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


@cache
def _fields(cls: Any) -> tuple[str, ...]:
    """Names of a dataclass's fields."""
    return tuple(field.name for field in dataclasses.fields(cls))


def _state(value: object) -> Mapping[str, Any]:
    """Attributes of an object, without what it computed from them."""
    if type(value).__getstate__ is not object.__getstate__:
        state: Mapping[str, Any] = value.__getstate__()  # type: ignore[assignment]
        return state
    if dataclasses.is_dataclass(value):
        cls: Any = type(value)
        return {name: getattr(value, name) for name in _fields(cls)}
    return {
        name: one
        for name, one in vars(value).items()
        if not isinstance(getattr(type(value), name, None), cached_property)
    }


def _is_rotation(R: NDArray[np.float64]) -> bool:
    """Whether a finite (3, 3) matrix is one."""
    return bool(rotation_error(R) <= _ROTATION_TOLERANCE and np.linalg.det(R) >= 0.0)
