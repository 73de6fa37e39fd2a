"""What a drive holds: its sensors, their stamps, its labels, and what is missing for which method."""

from __future__ import annotations

from sst_graph.data.info.summary import DriveInfo, drive_info
from sst_graph.data.info.text import info_text

__all__ = ["DriveInfo", "drive_info", "info_text"]
