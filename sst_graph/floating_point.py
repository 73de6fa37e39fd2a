"""What NumPy does about floating-point errors here, whatever the calling program has set."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import numpy as np

_P = ParamSpec("_P")
_R = TypeVar("_R")


def with_usual_errors(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """The function under NumPy's defaults: exp(-1000) is 0 here, and no error, also after ``np.seterr``."""

    @wraps(function)
    def under_defaults(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with np.errstate(divide="warn", over="warn", under="ignore", invalid="warn"):
            return function(*args, **kwargs)

    return under_defaults
