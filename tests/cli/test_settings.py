"""``sst-graph settings`` and the page that it makes."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from sst_graph.batch import CalibrationConfig
from sst_graph.cli import main
from sst_graph.config import Settings, setting, walk_settings, with_overrides
from sst_graph.config.listing import SettingEntry, as_markdown, as_text, list_settings
from sst_graph.tracker.config import TrackerConfig


@dataclass(frozen=True)
class Below(Settings):
    sigma_px: float = setting(1.5, more_than=0.0, at_most=10.0, doc="Deviation; larger for poor masks.")
    focal: float = setting(0.1, at_least=0.0, at_most=1.0, unit="relative")


@dataclass(frozen=True)
class Top(Settings):
    mode: Literal["auto", "never"] = setting("auto", doc="Either | or.")
    frames: int | None = setting(None, at_least=1, less_than=9)
    window: tuple[int, ...] = setting((2, 3), at_least=1, at_most=9, length=(1, 4))
    below: Below = field(default_factory=lambda: Below(sigma_px=2.0))


ENTRIES = [
    SettingEntry("mode", '"auto"', "", "auto, never", "Either | or."),
    SettingEntry("frames", "null", "", "whole number, 1 to below 9, or null", ""),
    SettingEntry("window", "[2, 3]", "", "list of (whole number, 1 to 9)", ""),
    SettingEntry("below.sigma_px", "2.0", "px", "above 0 to 10", "Deviation; larger for poor masks."),
    SettingEntry("below.focal", "0.1", "relative", "0 to 1", ""),
]


def test_an_entry_holds_what_is_declared_and_the_default_in_its_place() -> None:
    assert list_settings(Top()) == ENTRIES
    assert list_settings(Top(), "below.s") == ENTRIES[3:4]


def test_as_text_and_markdown() -> None:
    assert as_text(ENTRIES[3:]) == (
        "below.sigma_px = 2.0 px  (above 0 to 10)\n    Deviation; larger for poor masks.\n"
        "below.focal = 0.1 relative  (0 to 1)\n"
    )
    assert (
        as_markdown(ENTRIES[:1]).splitlines()[2] == '| `mode` | `"auto"` |  | auto, never | Either \\| or. |'
    )


def test_all_settings_of_both_commands_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["settings", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    names = {command: [entry["name"] for entry in entries] for command, entries in found.items()}
    assert names["calibrate"] == [name for name, _, _ in walk_settings(CalibrationConfig)]
    tracker = [name for name, _, _ in walk_settings(TrackerConfig)]
    assert [*(f"calibration.{name}" for name in names["calibrate"]), *names["track"]] == tracker
    # a default that is printed can be given
    overrides = [f"{entry['name']}={json.dumps(entry['default'])}" for entry in found["calibrate"]]
    assert with_overrides(CalibrationConfig(), overrides) == CalibrationConfig()


def test_a_filter_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["settings", "drift."]) == 0
    out = capsys.readouterr().out
    assert "calibrate: 0 settings" in out and "drift.rotation_deg = 0.005" in out and "window" not in out
    assert main(["settings", "nothing.like.it"]) == 2
    assert "no name contains it" in capsys.readouterr().err


def test_the_names_of_the_help_are_names_of_settings(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["settings", "--help"])
    said = re.search(r"such as (\S+) or (\S+)", " ".join(capsys.readouterr().out.split()))
    assert said is not None
    for name in said.groups():
        assert main(["settings", name]) == 0 and f"\n{name}" in capsys.readouterr().out


def test_the_page_is_what_the_command_prints(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["settings", "--markdown"]) == 0
    page = Path(__file__).resolve().parents[2] / "docs" / "reference" / "settings.md"
    assert capsys.readouterr().out == page.read_text(encoding="utf-8")
