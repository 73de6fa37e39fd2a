"""A start from the files of other programs: extrinsic and time offset, whatever way a format has them."""

from __future__ import annotations

from sst_graph.imports.frames import ImportOptions
from sst_graph.imports.reading import FORMATS, ImportedCalibration, import_calibration, read_tree

__all__ = ["FORMATS", "ImportOptions", "ImportedCalibration", "import_calibration", "read_tree"]
