"""Arrays that are seldom read, kept on disk: the first in memory, the others in an unnamed temporary file.

A drive of any length then takes little more memory than a short one. What is read back is what was put there,
bit by bit. The file has no name, so that nothing is left of it however the process ends; it lies where
:mod:`tempfile` puts such files (``TMPDIR``). Where none can be written, everything stays in memory.
"""

from __future__ import annotations

import logging
import math
import mmap
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, fields
from io import FileIO
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import count_of

_LOG = logging.getLogger(__name__)
_T = TypeVar("_T")

IN_MEMORY_BYTES = 32 * 1024 * 1024
"""Bytes of arrays that a store keeps in memory: those of a dozen frames with pictures of KITTI's size. Beyond
that each is read in a tenth of a millisecond, and those of a long drive do not add up."""
_MAPPED_BYTES = 128 * 1024
"""Arrays of at least so many bytes are mapped: a match looks at a few hundred pixels of the 4 MB of a
picture's gradients, and no more is read."""
_MAPPED_AT_ONCE = 64 * 1024 * 1024
"""A longer file is mapped anew after so many bytes of arrays: what was looked at in them is memory of the
process as long as the mapping lasts."""
_ALIGNMENT = 64
"""Arrays begin at multiples of so many bytes in the file."""


class ArrayStore:
    """Arrays in memory up to a number of bytes, the others in one temporary file."""

    def __init__(self, in_memory_bytes: int = IN_MEMORY_BYTES) -> None:
        """in_memory_bytes: of the first arrays, which stay in memory."""
        self._left = in_memory_bytes
        self._file: FileIO | None = None
        self._end = 0
        self._writable = True
        self._mapped: mmap.mmap | None = None
        self._read_from_it = 0

    def __del__(self) -> None:
        if (file := getattr(self, "_file", None)) is not None:
            file.close()

    def put(self, array: NDArray[Any], dtype: Any = None) -> Any:
        """Keep an array -> a :class:`StoredArray`, which a field that is :func:`storable` takes for it.

        Args:
            dtype: that it comes back with; by default its own.
        """
        wanted = array.dtype if dtype is None else np.dtype(dtype)
        array = np.ascontiguousarray(array)
        if array.nbytes <= max(self._left, 0) or not self._write(array):
            self._left -= array.nbytes
            return StoredArray(array, wanted)
        return StoredArray(_Place(self, self._end - array.nbytes, array.dtype, array.shape), wanted)

    def _write(self, array: NDArray[Any]) -> bool:
        """Append to the file; False where that does not go."""
        if not self._writable:
            return False
        data = array.reshape(-1).view(np.uint8).data
        # NumPy copies the whole of an array that is not aligned to look up one value in it.
        start = self._end + -self._end % _ALIGNMENT
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(prefix="sst-graph-", buffering=0)  # noqa: SIM115
            written = 0
            while written < len(data):
                written += os.pwrite(self._file.fileno(), data[written:], start + written)
        except OSError as error:
            self._writable = False
            _LOG.warning(
                "%s: %s: what is kept of the frames stays in memory", tempfile.gettempdir(), error.strerror
            )
            return False
        self._end = start + len(data)
        return True

    def read(self, start: int, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
        """An array that lies in the file; a large one cannot be written to.

        Raises:
            OSError: it cannot be read.
        """
        assert self._file is not None
        count = math.prod(shape)
        size = count * dtype.itemsize
        if size >= _MAPPED_BYTES:
            with suppress(OSError, ValueError):  # of a file that cannot be mapped
                mapped = self._mapping(start + size, size)
                return np.frombuffer(mapped, dtype, count, start).reshape(shape)
        data = os.pread(self._file.fileno(), size, start)
        if len(data) < size:
            raise OSError(f"the temporary file of a drive ends {count_of(size - len(data), 'byte')} early")
        return np.frombuffer(bytearray(data), dtype).reshape(shape)

    def _mapping(self, end: int, size: int) -> mmap.mmap:
        """The file up to ``end`` or farther, for an array of so many bytes."""
        assert self._file is not None
        # Kept: to map each array takes ten times as long as to look up what a match needs of it.
        mapped, much = self._mapped, min(self._read_from_it, self._end) > _MAPPED_AT_ONCE
        if mapped is None or len(mapped) < end or much:
            mapped = self._mapped = mmap.mmap(self._file.fileno(), self._end, access=mmap.ACCESS_READ)
            self._read_from_it = 0
        self._read_from_it += size
        return mapped


class StoredArray:
    """An array in an array store."""

    def __init__(self, kept: NDArray[Any] | _Place, dtype: np.dtype[Any]) -> None:
        self._kept, self._dtype = kept, dtype

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array, which is not read for it."""
        return self._kept.shape

    def get(self) -> NDArray[Any]:
        """The array; read again each time where it lies in the file."""
        kept = self._kept
        array = kept.store.read(kept.start, kept.dtype, kept.shape) if isinstance(kept, _Place) else kept
        return array.astype(self._dtype, copy=False)

    def __reduce__(self) -> tuple[Any, ...]:
        """Elsewhere there is no such file: the array itself goes there."""
        return StoredArray, (self.get(), self._dtype)


@dataclass(frozen=True)
class _Place:
    """Where in its file an array lies."""

    store: ArrayStore
    start: int
    dtype: np.dtype[Any]
    shape: tuple[int, ...]


class _Field:
    """Attribute that accepts an array or a :class:`StoredArray`, and returns the array."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, instance: object, owner: type) -> Any:
        if instance is None:
            return self
        value = instance.__dict__[self._name]
        return value.get() if isinstance(value, StoredArray) else value

    def __set__(self, instance: object, value: object) -> None:
        instance.__dict__[self._name] = value


def shape_of(instance: object, name: str) -> tuple[int, ...]:
    """Shape of the array in a field that is :func:`storable`; nothing is read."""
    shape: tuple[int, ...] = vars(instance)[name].shape
    return shape


def replaced(instance: _T, **changes: Any) -> _T:
    """As :func:`dataclasses.replace`, with the other fields as they are kept: nothing is read."""
    kept = {field.name: vars(instance)[field.name] for field in fields(cast(Any, instance)) if field.init}
    return type(instance)(**{**kept, **changes})


def storable(*names: str) -> Callable[[type[_T]], type[_T]]:
    """Class decorator: the named fields accept a :class:`StoredArray` for an array, and return the array."""

    def declared(cls: type[_T]) -> type[_T]:
        for name in names:
            setattr(cls, name, _Field(name))
        return cls

    return declared
