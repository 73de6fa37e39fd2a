"""A calibration in the formats of others, and as a factor for graphs of others."""

from __future__ import annotations

from sst_graph.export.formats import FORMATS, export_text
from sst_graph.export.marginal import (
    EXTRINSIC,
    TIME_OFFSET,
    CalibrationMarginal,
    Common,
    common_errors,
    fuse_graphs,
    fuse_marginals,
    marginal_of_graph,
    marginal_of_result,
    read_marginal,
)
from sst_graph.export.options import ExportOptions

__all__ = [
    "EXTRINSIC",
    "FORMATS",
    "TIME_OFFSET",
    "CalibrationMarginal",
    "Common",
    "ExportOptions",
    "common_errors",
    "export_text",
    "fuse_graphs",
    "fuse_marginals",
    "marginal_of_graph",
    "marginal_of_result",
    "read_marginal",
]
