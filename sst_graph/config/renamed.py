"""Settings by names that they do not have: the name, or what stands in their place.

Names are dotted as ``--set`` takes them: of ``calibrate``, or of ``track`` and the experiments for their own.
"""

from __future__ import annotations

from collections.abc import Mapping

RENAMED: Mapping[str, str] = {
    "camera.delay_sigma_s": "camera.time_offset_sigma_s",
    "delay_s": "time_offset_s",
}
"""Old name -> the name of the setting."""

CONSTANTS: Mapping[str, str] = {}
"""Old name -> the constant in its place and its value, ``sst_graph.graph.outer_loop.MAX_STEPS = 6``; or,
where nothing is in its place, a sentence without a dot at its end."""
