"""Each setting of calibrate and track is documented where it is declared."""

from __future__ import annotations

from sst_graph.batch import CalibrationConfig
from sst_graph.config.listing import list_settings
from sst_graph.tracker.config import TrackerConfig

ENTRIES = [
    *list_settings(CalibrationConfig()),
    *(entry for entry in list_settings(TrackerConfig()) if not entry.name.startswith("calibration.")),
]


def test_there_are_few_enough_to_read() -> None:
    assert len(ENTRIES) <= 60


def test_every_setting_has_a_text() -> None:
    assert [entry.name for entry in ENTRIES if not entry.doc.endswith(".")] == []
    assert len({entry.doc for entry in ENTRIES}) == len(ENTRIES)
