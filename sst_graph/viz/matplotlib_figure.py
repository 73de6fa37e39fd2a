"""matplotlib's ``Figure``, imported when a plot is made; pyplot and its global state are left alone."""

from __future__ import annotations

from typing import Any

from sst_graph.errors import ConfigError, MissingDependencyError


def figure_class(otherwise: str = "") -> Any:
    """``matplotlib.figure.Figure``.

    Args:
        otherwise: what to do without matplotlib, after a comma.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ConfigError: it cannot start, because of MPLBACKEND or its own settings file.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingDependencyError(
            f"plots need matplotlib, which is not installed: pip install matplotlib{otherwise}"
        ) from error
    except Exception as error:
        raise ConfigError(f"matplotlib does not start (MPLBACKEND, matplotlibrc?): {error}") from error
    return Figure
