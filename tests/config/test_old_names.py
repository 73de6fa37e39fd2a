"""Settings by names that they do not have any more."""

from __future__ import annotations

import importlib
import re
from typing import Any

import pytest

from sst_graph.batch import CalibrationConfig
from sst_graph.config import from_dict, walk_settings, with_overrides
from sst_graph.config.old_names import FIXED, RENAMED, fixed_in
from sst_graph.errors import ConfigError
from sst_graph.experiments.accuracy import AccuracyConfig
from sst_graph.experiments.registry import EXPERIMENTS
from sst_graph.tracker.config import TrackerConfig


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("sweep.window.voxel_m", "sst_graph.odometry.sweep"),
        ("calibration.sweep.window.movers.voxel_m", "sst_graph.odometry.static_points"),
        ("images", "sst_graph.tracker.inputs"),
        ("image", ""),
    ],
)
def test_what_is_fixed_is_named_with_its_place(name: str, place: str) -> None:
    assert fixed_in(name) == place


def test_a_name_that_is_misspelled_is_not_said_to_be_fixed() -> None:
    with pytest.raises(ConfigError, match=r"unknown setting 'alarm\.chi'; did you mean 'alarm\.chi2'\?"):
        from_dict(TrackerConfig, {"alarm": {"chi": 9.0}})


ROOTS: list[Any] = [
    CalibrationConfig(),
    TrackerConfig(),
    *(experiment.config for experiment in EXPERIMENTS.values()),
]


def known_names() -> set[str]:
    return {name for root in ROOTS for name, _, _ in walk_settings(type(root))}


def test_every_old_name_leads_to_a_setting() -> None:
    assert set(RENAMED.values()) <= known_names()
    assert not set(RENAMED) & (known_names() | set(FIXED))


@pytest.mark.parametrize("place", sorted(set(FIXED.values())))
def test_what_is_fixed_is_fixed_in_a_module(place: str) -> None:
    importlib.import_module(place)


@pytest.mark.parametrize("old", RENAMED)
def test_an_old_name_is_refused_with_the_new_one(old: str) -> None:
    roots = [root for root in ROOTS if RENAMED[old] in {name for name, _, _ in walk_settings(type(root))}]
    assert roots
    for root in roots:
        data: Any = 1
        for key in reversed(old.split(".")):
            data = {key: data}
        with pytest.raises(ConfigError, match=rf"it is called '{re.escape(RENAMED[old])}'$"):
            from_dict(type(root), data, root)


def test_an_old_name_in_the_place_of_a_table_or_below_another_command() -> None:
    with pytest.raises(ConfigError, match=r"unknown setting 'undersides\.use'; it is called 'lower_edges'$"):
        with_overrides(CalibrationConfig(), ["undersides.use=never"])
    below = {"calibration": {"delay_per_drive": True}}
    with pytest.raises(ConfigError, match=r"it is called 'calibration\.time_offset_per_drive'$"):
        from_dict(AccuracyConfig, below)
    # A name of another command.
    with pytest.raises(ConfigError, match=r"unknown setting 'drift\.offset_s'; (?!it is called)"):
        from_dict(CalibrationConfig, {"drift": {"offset_s": 1.0}})
