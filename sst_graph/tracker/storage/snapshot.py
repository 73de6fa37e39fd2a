"""Snapshot of an object and all that it holds, restored where an update fails."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from functools import cache
from typing import Any

_LISTS = (list, set, deque)
_class_of: Callable[[object], Any] = type
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
        waiting: list[Any] = [root] if _is_followed(_class_of(root)) else []
        while waiting:
            value = waiting.pop()
            if id(value) in seen:
                continue
            seen.add(id(value))
            cls = _class_of(value)
            inside: Iterable[Any]
            if cls is tuple:
                inside = value
            elif cls in _LISTS:
                inside = tuple(value)
                self._saved.append((value, inside))
            else:
                held = value if cls is dict else vars(value)
                self._saved.append((held, dict(held)))
                inside = held.values()
            # Most of what is held never changes in place: it is left out before it is looked at.
            waiting += [one for one in inside if _is_followed(_class_of(one))]

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
    if cls in _LISTS or cls is dict or cls is tuple:
        return True
    if not f"{cls.__module__}.".startswith(_PACKAGES) or issubclass(cls, tuple | int | str):
        return False
    if not getattr(cls, "rolls_back", True):
        return False
    frozen = getattr(getattr(cls, "__dataclass_params__", None), "frozen", False)
    return not frozen and getattr(cls, "__dictoffset__", 0) != 0
