"""Settings by names that they do not have any more."""

from __future__ import annotations

import importlib
import json
import logging
from dataclasses import dataclass, field
from typing import Any

import pytest

from sst_graph.batch import CalibrationConfig
from sst_graph.config import Settings, from_dict, setting, to_dict, walk_settings
from sst_graph.config.old_names import FIXED, RENAMED, fixed_in, with_new_names
from sst_graph.errors import ConfigError
from sst_graph.experiments.registry import EXPERIMENTS
from sst_graph.tracker.config import TrackerConfig


@dataclass(frozen=True)
class Edges(Settings):
    sigma_px: float = setting(1.0, at_least=0.1, at_most=9.0)
    use: bool = True


@dataclass(frozen=True)
class Method(Settings):
    time_offset_s: float = setting(0.1, at_least=0.0, at_most=1.0)
    lower_edges: Edges = field(default_factory=Edges)


@dataclass(frozen=True)
class Online(Settings):
    window: int = setting(6, at_least=1, at_most=9)
    calibration: Method = field(default_factory=Method)


OLD = {"delay_s": "time_offset_s", "undersides.use": "lower_edges.use", "scans": "window"}
SAME = {"delay_s": "time_offset_s", "lag.s": "time_offset_s"}


def new(cls: Any, data: dict[str, Any]) -> Any:
    return with_new_names(cls, data, OLD)


def test_an_old_name_is_the_new_one_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        found = new(Method, {"delay_s": 0.2, "undersides": {"use": False}, "lower_edges": {"sigma_px": 2}})
    assert from_dict(Method, found) == Method(0.2, Edges(2.0, False))
    assert [record.getMessage() for record in caplog.records] == [
        "setting 'delay_s' is called 'time_offset_s': use that name",
        "setting 'undersides.use' is called 'lower_edges.use': use that name",
    ]


def test_names_below_the_calibration_of_another_command() -> None:
    found = new(Online, {"scans": 3, "calibration": {"undersides": {"use": False}}})
    assert from_dict(Online, found) == Online(3, Method(lower_edges=Edges(use=False)))


def test_known_names_pass_without_a_word(caplog: pytest.LogCaptureFixture) -> None:
    given = {"time_offset_s": 0.3, "lower_edges": {"use": False}}
    assert new(Method, given) is given and not caplog.records


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


def test_old_and_new_name_together_are_refused() -> None:
    with pytest.raises(ConfigError, match="'delay_s' and 'time_offset_s': found both"):
        new(Method, {"delay_s": 0.2, "time_offset_s": 0.3})


def test_several_old_names_of_one_setting_must_agree() -> None:
    assert with_new_names(Method, {"delay_s": 0.2, "lag": {"s": 0.2}}, SAME) == {"time_offset_s": 0.2}
    with pytest.raises(ConfigError, match=r"'delay_s' and 'lag\.s', both called 'time_offset_s'"):
        with_new_names(Method, {"delay_s": 0.2, "lag": {"s": 0.0}}, SAME)


def test_a_table_that_is_a_single_setting_now() -> None:
    moved = {"time_offset_s.mean": "time_offset_s"}
    assert with_new_names(Method, {"time_offset_s": {"mean": 0.2}}, moved) == {"time_offset_s": 0.2}
    both = {"time_offset_s": {"mean": 0.2, "sigma": 0.1}}
    with pytest.raises(ConfigError, match="found both"):
        with_new_names(Method, both, moved)
    assert from_dict(CalibrationConfig, {"lower_edges": {"use": "never"}}).lower_edges == "never"


@pytest.mark.parametrize(
    "data",
    [
        {"foo": 3, "undersides": {}},
        {"undersides": 3},
        {"undersides": {"use": {"x": 1}}},
        {"scans": 3},  # a name of another command
    ],
)
def test_what_the_tables_do_not_know_stays_to_be_refused(data: dict[str, Any]) -> None:
    assert new(Method, data) == data
    with pytest.raises(ConfigError, match="unknown setting"):
        from_dict(Method, new(Method, data))


def test_a_value_in_the_place_of_the_new_table_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"'undersides\.use' and 'lower_edges': found both"):
        from_dict(Method, new(Method, {"lower_edges": 3, "undersides": {"use": True}}))


def test_tables_nested_hundreds_deep_are_no_recursion_error() -> None:
    deep = json.loads('{"a":' * 500 + "1" + "}" * 500)
    assert new(Method, deep) is deep


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
def test_the_default_under_an_old_name_is_the_default(old: str) -> None:
    roots = [root for root in ROOTS if RENAMED[old] in {name for name, _, _ in walk_settings(type(root))}]
    assert roots
    for root in roots:
        check_default(root, old)


def check_default(default: Any, old: str) -> None:
    value = to_dict(default)
    for key in RENAMED[old].split("."):
        value = value[key]
    for key in reversed(old.split(".")):
        value = {key: value}
    assert from_dict(type(default), value, default) == default
