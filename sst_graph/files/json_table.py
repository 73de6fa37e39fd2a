"""Typed access to a JSON object that was read from a file; every complaint names its place."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from sst_graph.errors import DataError, printable
from sst_graph.files.checked_values import (
    check_covariance,
    check_finite,
    checked_pose,
    checked_text,
    checked_time_offset_s,
)
from sst_graph.types import FloatArray

MAX_SENTENCE = 4000
"""Characters of a sentence that is kept."""

_REQUIRED: Any = object()


def json_table(document: Any, place: str | Path, name: str, version: int) -> JsonTable:
    """The object of a document that says ``{"format": name, "version": version, ...}``.

    Raises:
        DataError: no object, or of another format or version.
    """
    if not isinstance(document, dict) or document.get("format") != name:
        found = document.get("format") if isinstance(document, dict) else type(document).__name__
        raise DataError(place, f"format {found!r:.60}", f"format '{name}'")
    if document.get("version") != version or isinstance(document.get("version"), bool):
        raise DataError(place, f"version {document.get('version')!r:.60}", f"version {version}")
    return JsonTable(document, str(place))


@dataclass(frozen=True)
class JsonTable:
    """A JSON object and where it was found. All methods raise DataError for a value of another type."""

    data: Mapping[str, Any]
    place: str

    def value(self, key: str, default: Any = _REQUIRED) -> Any:
        if key not in self.data and default is _REQUIRED:
            raise DataError(self.place, f"no entry '{key}'", "the file as it was written, whole")
        return self.data.get(key, default)

    def _at(self, key: str) -> str:
        return f"{self.place}: {key}"

    def _typed(self, key: str, kinds: Any, expected: str, default: Any = _REQUIRED) -> Any:
        value = self.value(key, default)
        if not isinstance(value, kinds) or isinstance(value, bool):
            raise DataError(self._at(key), f"{value!r:.60}", expected)
        return value

    def number(self, key: str) -> float:
        """A finite number."""
        number = float(self._typed(key, (int, float), "a number"))
        if not math.isfinite(number):
            raise DataError(self._at(key), f"{number}", "a finite number")
        return number

    def integer(self, key: str) -> int:
        """A whole number of 64 bits."""
        found = int(self._typed(key, int, "a whole number"))
        if not -(2**63) <= found < 2**63:
            raise DataError(self._at(key), f"{found:.3g}", "a whole number of 64 bits")
        return found

    def text(self, key: str, default: Any = _REQUIRED) -> str:
        """Text without control characters."""
        return checked_text(self._typed(key, str, "text", default), self._at(key))

    def sequence(self, key: str) -> list[Any]:
        return list(self._typed(key, list, "a list", []))

    def sentence(self, key: str) -> str:
        """Text for people, on one line; control characters appear as in a Python literal."""
        return _one_line(self._typed(key, str, "text"))

    def sentences(self, key: str) -> tuple[str, ...]:
        """A list of such texts."""
        items = self.sequence(key)
        for item in items:
            if not isinstance(item, str):
                raise DataError(self._at(key), f"{item!r:.60}", "text")
        return tuple(map(_one_line, items))

    def mapping(self, key: str) -> dict[str, Any]:
        return dict(self._typed(key, dict, "an object", {}))

    def table(self, key: str) -> JsonTable:
        return JsonTable(self._typed(key, dict, "an object"), self._at(key))

    def tables(self, key: str) -> list[JsonTable]:
        items = self.sequence(key)
        for item in items:
            if not isinstance(item, dict):
                raise DataError(self._at(key), f"{item!r:.60}", "objects")
        return [JsonTable(item, f"{self._at(key)}[{i}]") for i, item in enumerate(items)]

    def matrix(self, key: str, shape: tuple[int, ...]) -> FloatArray:
        """A finite array; numbers only, for NumPy would take text and truth values as well."""
        value = self.value(key)
        if not _numbers_only(value):
            raise DataError(self._at(key), "no numeric array", f"shape {shape}")
        try:
            array = np.array(value, dtype=np.float64)
        except (ValueError, TypeError, OverflowError):
            raise DataError(self._at(key), "no numeric array", f"shape {shape}") from None
        check_finite(self._at(key), array, shape)
        return array

    def covariance(self, key: str, size: int) -> FloatArray:
        """A covariance (size, size) with sane sigmas."""
        found = self.matrix(key, (size, size))
        check_covariance(self._at(key), found)
        return found

    def pose(self, key: str) -> gtsam.Pose3:
        """A rigid transform (4, 4)."""
        return checked_pose(self.matrix(key, (4, 4)), self._at(key))

    def time_offset_s(self, key: str) -> float:
        """A time offset [s]."""
        return checked_time_offset_s(self.number(key), self._at(key))


def _one_line(text: str) -> str:
    return printable(" ".join(text.split()), MAX_SENTENCE)


def _numbers_only(value: Any) -> bool:
    if isinstance(value, list):
        return all(map(_numbers_only, value))
    return isinstance(value, (int, float)) and not isinstance(value, bool)
