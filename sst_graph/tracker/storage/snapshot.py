"""Snapshot of an object and all that it holds, restored where an update fails."""

from __future__ import annotations

from collections import deque
from functools import cache
from typing import Any

_CONTAINERS = (dict, list, set, deque)
_PACKAGES = ("sst_graph.",)


class Snapshot:
    """What an object holds, as it is now; as a context, put back where the block fails.

    Lists, dictionaries, sets, deques and the package's own objects are recorded, one level each, wherever
    they are reached from; :meth:`restore` puts their contents back into the very same objects. All else
    (arrays, poses, iSAM2, frozen dataclasses) must never change in place, only be replaced. Objects of a
    class whose ``rolls_back`` is False are not restored.
    """

    def __init__(self, root: object) -> None:
        self._saved: list[tuple[Any, Any]] = []
        seen: set[int] = set()
        waiting: list[Any] = [root]
        while waiting:
            value = waiting.pop()
            cls: Any = type(value)
            if id(value) in seen or not _is_followed(cls):
                continue
            seen.add(id(value))
            if isinstance(value, tuple):
                waiting.extend(value)
            elif isinstance(value, dict):
                self._saved.append((value, dict(value)))
                waiting.extend(value.values())
            elif isinstance(value, list | set | deque):
                self._saved.append((value, tuple(value)))
                waiting.extend(value)
            else:
                attributes = vars(value)
                self._saved.append((attributes, dict(attributes)))
                waiting.extend(attributes.values())

    def __enter__(self) -> Snapshot:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self.restore()

    def restore(self) -> None:
        """Put everything back."""
        for value, saved in self._saved:
            value.clear()
            if isinstance(value, list | deque):
                value.extend(saved)
            else:
                value.update(saved)


@cache
def _is_followed(cls: Any) -> bool:
    """Whether instances of a class change in place, or hold others that do."""
    if cls in _CONTAINERS or cls is tuple:
        return True
    if not f"{cls.__module__}.".startswith(_PACKAGES) or issubclass(cls, tuple | int | str):
        return False
    if not getattr(cls, "rolls_back", True):
        return False
    frozen = getattr(getattr(cls, "__dataclass_params__", None), "frozen", False)
    return not frozen and getattr(cls, "__dictoffset__", 0) != 0
