"""What the outputs of a network mean: a data set's numbers by name, or numbers listed in a YAML file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.classes import ClassMap, class_map, class_table, look_up
from sst_graph.errors import ConfigError, DataError, count_of
from sst_graph.types import SemanticClass

MAX_NUMBER = 0xFFFF
"""Largest label number."""
_OTHERS = "others"


@dataclass(frozen=True)
class LabelNumbers:
    """Classes by the numbers of a network.

    Attributes:
        name: of the data set, or of the file that lists them.
        classes: by number.
        others: class of every number that is not listed; None: there must be none.
        outputs: number of outputs that the network must have; None: as many as are listed or more.
    """

    name: str
    classes: Mapping[int, SemanticClass]
    others: SemanticClass | None = None
    outputs: int | None = None

    @classmethod
    def of(cls, one: ClassMap) -> LabelNumbers:
        """The numbers of a data set."""
        return cls(one.name, one.classes, None, one.outputs)

    @property
    def known(self) -> frozenset[SemanticClass]:
        """Classes that can be aligned and that some number means."""
        return frozenset(self.classes.values()) - {SemanticClass.OTHER, SemanticClass.IGNORE}

    def of_outputs(self, count: int, place: str | Path) -> NDArray[np.uint8]:
        """Class (count,) of each output of a network with ``count`` of them.

        Raises:
            DataError: another number of outputs than the data set has classes, or some that are not listed.
        """
        if self.outputs is not None and count != self.outputs:
            raise DataError(
                place, f"{count_of(count, 'output')} a pixel", f"{self.outputs}, one a class of {self.name}"
            )
        missing = [k for k in range(count) if k not in self.classes]
        if missing and self.others is None:
            found = f"{count_of(count, 'output')} a pixel, and no class for output {missing[0]}"
            raise DataError(place, found, f"a class for each in {self.name}, or a class for {_OTHERS}")
        beyond = [k for k in self.classes if k >= count and k != 255]
        if beyond and self.outputs is None:
            raise DataError(
                place,
                f"{count_of(count, 'output')} a pixel",
                f"more than {max(beyond)}, which {self.name} names",
            )
        return np.array([int(self.classes.get(k, self.others)) for k in range(count)], np.uint8)  # type: ignore[arg-type]

    def of_labels(self, labels: NDArray[Any], place: str | Path) -> NDArray[np.uint8]:
        """Classes (...) of label numbers (...).

        Raises:
            DataError: a number that is not listed.
        """
        if labels.size and not 0 <= int(labels.min()) <= int(labels.max()) <= MAX_NUMBER:
            found = f"labels from {labels.min()} to {labels.max()}"
            raise DataError(place, found, f"0 to {MAX_NUMBER}")
        table = class_table(self.classes, MAX_NUMBER + 1)
        if self.others is not None:
            listed = np.zeros(len(table), bool)
            listed[list(self.classes)] = True
            table[~listed] = self.others
        return look_up(table, labels.astype(np.uint16), place, f"a number of {self.name}")


def label_numbers(value: Any, place: str) -> LabelNumbers:
    """What ``classes`` of a YAML file says: the name of a data set, or {number: class, others: class}.

    Raises:
        DataError: something else, an unknown name of a data set or of a class, a number out of range.
    """
    if isinstance(value, str):
        try:
            return LabelNumbers.of(class_map(value))
        except ConfigError as error:
            raise DataError(place, f"{value!r:.60}", str(error).partition("expected ")[2]) from None
    if not isinstance(value, dict) or not value:
        raise DataError(place, f"{value!r:.60}", "the name of a data set, or a table of number: class")
    others = _class(value[_OTHERS], place) if _OTHERS in value else None
    classes: dict[int, SemanticClass] = {}
    for number, name in value.items():
        if number == _OTHERS:
            continue
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number <= MAX_NUMBER:
            raise DataError(place, f"the number {number!r:.40}", f"0 to {MAX_NUMBER}, or {_OTHERS}")
        classes[number] = _class(name, place)
    if not classes:
        raise DataError(place, f"a class for {_OTHERS} only", "number: class")
    return LabelNumbers(place, classes, others)


def _class(value: Any, place: str) -> SemanticClass:
    names = {one.name.lower(): one for one in SemanticClass if one != SemanticClass.OBJECT}
    if not isinstance(value, str) or value.lower() not in names:
        raise DataError(place, f"the class {value!r:.40}", f"one of {', '.join(names)}")
    return names[value.lower()]
