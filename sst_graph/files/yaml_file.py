"""Reading of small YAML files: numbers, text, lists, tables; no anchors, no objects."""

from __future__ import annotations

import contextlib
import math
from pathlib import Path
from typing import Any

from sst_graph.errors import DataError, count_of, one_line, optional_module
from sst_graph.files.reading import FileKind, check_values, read_text, said_of_values

YAML = FileKind("a YAML file", 64 * 1024)
_MAX_DEPTH = 16
_OPENCV_MATRIX = "tag:yaml.org,2002:opencv-matrix"


def read_yaml(path: Path) -> dict[str, Any]:
    """The table in a YAML file; errors as of :func:`parse_yaml`, and of a missing file."""
    return parse_yaml(read_text(path, YAML), path)


def parse_yaml(text: str, place: str | Path) -> dict[str, Any]:
    """The table in a YAML text; a matrix of OpenCV is a table of rows, cols, dt, data.

    Raises:
        DataError: no YAML, anchors and aliases, tags of objects, deep nesting, a name twice, a whole number
            of more than MAX_DIGITS digits, no table.
        MissingDependencyError: PyYAML is not installed.
    """
    without = f"{place}: reading YAML needs PyYAML, which is not installed"
    optional_module("yaml", without, "yaml")
    import yaml

    if text.startswith("%YAML:"):  # OpenCV's first line is no directive of YAML
        text = text.partition("\n")[2]
    # What "ros2 topic echo --once" prints ends with the beginning of another document.
    text = text.rstrip().removesuffix("\n---") + "\n"

    class Loader(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML has no types
        """Numbers, text, lists and tables of distinct names, and OpenCV's matrices."""

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            names = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
            if len(set(names)) < len(names):
                twice = next(name for k, name in enumerate(names) if name in names[:k])
                raise ValueError(f"{twice!r:.60} twice in one table")
            return super().construct_mapping(node, deep)

    def matrix(loader: Any, node: Any) -> Any:
        return loader.construct_mapping(node, deep=True)

    Loader.add_constructor(_OPENCV_MATRIX, matrix)
    try:
        _check_events(yaml, text)
        value = yaml.load(text, Loader)  # a SafeLoader
        check_values(value, _MAX_DEPTH + 1)
    except (yaml.YAMLError, ValueError, TypeError, OverflowError, AttributeError, RecursionError) as error:
        found = said_of_values(error) if isinstance(error, ValueError) else one_line(error)
        raise DataError(place, f"no YAML ({found:.200})", "numbers, text, lists and tables") from None
    if not isinstance(value, dict):
        found = "nothing" if value is None else f"a YAML {type(value).__name__}"
        raise DataError(place, found, "a table")
    return value


def _check_events(yaml: Any, text: str) -> None:
    """Refuse what takes memory or time beyond the text's own size.

    Raises:
        ValueError: an alias, or deep nesting.
    """
    depth = 0
    for event in yaml.parse(text, yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            raise ValueError("an alias")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > _MAX_DEPTH:
            raise ValueError(f"more than {_MAX_DEPTH} levels")


def number(value: Any, place: str) -> float:
    """A finite number.

    Raises:
        DataError: something else.
    """
    if isinstance(value, str):  # YAML 1.1 takes 1e-3 for text
        with contextlib.suppress(ValueError):
            value = float(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > 1e300:
        raise DataError(place, f"{value!r:.60}", "a finite number")
    if not math.isfinite(value):
        raise DataError(place, f"{value!r:.60}", "a finite number")
    return float(value)


def numbers(value: Any, place: str, count: int | None = None) -> list[float]:
    """Finite numbers of a list, of lists of lists, or of a matrix of OpenCV or ROS; row by row.

    Raises:
        DataError: something else, or another number of them.
    """
    if isinstance(value, dict) and "data" in value:
        value = value["data"]
    if not isinstance(value, list):
        raise DataError(place, f"{value!r:.60}", "a list of numbers")
    flat: list[Any] = []
    for item in value:
        flat.extend(item if isinstance(item, list) else [item])
    if count is not None and len(flat) != count:
        raise DataError(place, count_of(len(flat), "number"), f"{count}")
    return [number(item, place) for item in flat]
