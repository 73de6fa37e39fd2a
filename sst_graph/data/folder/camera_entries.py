"""Entries of a camera file by their names: intrinsics, and what a lens does."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from sst_graph.errors import DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.files.checked_values import pinhole_camera
from sst_graph.files.yaml_file import number

_OF_LENS = re.compile(r".*(dist|coef).*", re.ASCII)
COEFFICIENT = re.compile(r"[kp]\d", re.ASCII)
"""Names of a lens's numbers, each alone (P1 is a matrix, too)."""


def plain_key(key: object) -> str:
    """In small letters without underscores."""
    return str(key).lower().replace("_", "")


def refuse_of_lens(
    table: Mapping[str, Any],
    known: Collection[str],
    path: str | Path,
    coefficient: re.Pattern[str] = COEFFICIENT,
) -> None:
    """Refuse entries of a lens that are not understood: without them the lens would pass for none.

    Args:
        coefficient: plain names of numbers that say what a lens does.

    Raises:
        DataError: there is one.
    """
    for key, value in table.items():
        plain, single = plain_key(key), not isinstance(value, list | dict)
        if str(key) not in known and (_OF_LENS.fullmatch(plain) or (single and coefficient.fullmatch(plain))):
            raise DataError(path, f"the key {key!r:.60}", f"of the lens {', '.join(known)}")


def pinhole_by_names(
    table: Mapping[str, Any], names: Sequence[str], path: str | Path, expected: str
) -> PinholeCamera:
    """Intrinsics of a table.

    Args:
        names: of fx, fy, cx, cy, width and height.
        expected: what an error says of one that is missing.

    Raises:
        DataError: one is missing or no number, a side is no whole number, or they are no camera's.
    """
    for name in names:
        if name not in table:
            raise DataError(path, f"no {name}", expected)
    fx, fy, cx, cy, *size = (number(table[name], f"{path} ({name})") for name in names)
    for side in size:
        if side != round(side):
            raise DataError(path, f"an image side of {side} px", "a whole number")
    return pinhole_camera((fx, fy, cx, cy), (int(size[0]), int(size[1])), path)
