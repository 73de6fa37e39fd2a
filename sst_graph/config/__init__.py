"""Frozen dataclasses as strict configuration: declared ranges, dictionaries, files, ``a.b=value`` overrides.

A settings class derives from :class:`Settings` and declares the range of a field beside its default::

    @dataclass(frozen=True)
    class SolverConfig(Settings):
        max_outer: int = setting(40, at_least=1, at_most=1000)
        kernel_px: tuple[float, ...] = setting((20.0, 5.0), more_than=0.0, at_most=1000.0, length=(1, 100))

Types and ranges are checked whenever an instance is built: by its constructor, ``dataclasses.replace``,
:func:`from_dict`, :func:`read_config` or :func:`with_overrides`. A number has to be finite; a bool is no
number. Rules that span fields stand in the class's own ``__post_init__``, which runs after that check.
Unknown names are refused with the nearest known one.
"""

from __future__ import annotations

from sst_graph.config.ranges import Bounds, Range, internal, setting
from sst_graph.config.reading import from_dict, read_config, with_overrides
from sst_graph.config.settings import Settings, expect_settings, settings_fields, to_dict, walk_settings

__all__ = [
    "Bounds",
    "Range",
    "Settings",
    "expect_settings",
    "from_dict",
    "internal",
    "read_config",
    "setting",
    "settings_fields",
    "to_dict",
    "walk_settings",
    "with_overrides",
]
