"""Point clouds in files of any common format."""

from __future__ import annotations

from sst_graph.data.point_files.cloud import PointFields
from sst_graph.data.point_files.reading import SUFFIXES, read_cloud

__all__ = ["SUFFIXES", "PointFields", "read_cloud"]
