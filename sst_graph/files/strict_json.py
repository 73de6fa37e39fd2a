"""JSON that every reader takes: no NaN, no infinity, UTF-8; one key of the document a line."""

from __future__ import annotations

import dataclasses
import enum
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

_LONE_SURROGATE = re.compile("[\ud800-\udfff]")


def strict_json(document: Mapping[str, Any]) -> str:
    """The text of a document, matrices one row a line; what is not finite becomes null.

    Text that is not Unicode (lone surrogates) is escaped, so that the whole can be written as UTF-8.
    """
    return _LONE_SURROGATE.sub(lambda match: f"\\\\u{ord(match[0]):04x}", _dump(json_able(document)))


def json_able(value: Any) -> Any:
    """``value`` with arrays, poses and tuples as lists, enums as names, and None for what is not finite."""
    if isinstance(value, Mapping):
        return {str(key): json_able(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return json_able(value.tolist())
    if isinstance(value, gtsam.Pose3):
        return json_able(value.matrix())
    if isinstance(value, (list, tuple)):
        return [json_able(item) for item in value]
    if isinstance(value, enum.Enum):
        return value.name.lower()
    if isinstance(value, np.generic):
        return json_able(value.item())
    if isinstance(value, Path):
        return str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return json_able({f.name: getattr(value, f.name) for f in dataclasses.fields(value)})
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _dump(document: dict[str, Any]) -> str:
    """Strict JSON, one key a line, matrices one row a line."""
    entries = []
    for key, value in document.items():
        rows = isinstance(value, list) and value and isinstance(value[0], (list, dict))
        if rows:
            body = ",\n".join("    " + json.dumps(row, allow_nan=False, ensure_ascii=False) for row in value)
            entries.append(f"  {json.dumps(key)}: [\n{body}\n  ]")
        else:
            entries.append(f"  {json.dumps(key)}: {json.dumps(value, allow_nan=False, ensure_ascii=False)}")
    return "{\n" + ",\n".join(entries) + "\n}"
