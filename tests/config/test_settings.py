"""Every setting that --config and --set reach: it declares a range, and nothing outside of it is taken."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import json
import pkgutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

import sst_graph
from checks.settings_walk import Worker, cases
from sst_graph.batch import CalibrationConfig
from sst_graph.config import Range, Settings, from_dict, read_config, to_dict, walk_settings, with_overrides
from sst_graph.errors import ConfigError, SstGraphError
from sst_graph.experiments.registry import EXPERIMENTS
from sst_graph.result import Status
from sst_graph.simulator import SimulationConfig
from sst_graph.tracker.config import TrackerConfig

ROOTS: dict[str, Any] = {
    "calibrate": CalibrationConfig(),
    "track": TrackerConfig(),
    "simulate": SimulationConfig(),
    **{name: experiment.config for name, experiment in EXPERIMENTS.items()},
}
"""Default settings of every command that has some."""
WRONG: list[Any] = [
    *(
        0,
        -1,
        1,
        10**400,
        -(10**400),
        10**5000,
        float("nan"),
        float("inf"),
        -float("inf"),
        1e300,
        -1e300,
        1e-300,
    ),
    *("", "x", "1", "\ud800", "a\nb", True, False, None),
    *([], [0], [-1], [None], ["x"], [True], [float("nan")], [[]], [[1.0]], [1] * 1000, {}, {"x": 1}),
]
TEXTS = [
    "0",
    "-1",
    "NaN",
    "1e300",
    "1e999999999",
    "1" + "0" * 400,
    "1" + "0" * 5000,
    "",
    "[]",
    "null",
    "[[1]]",
]
"""Texts for --set; the values of :data:`WRONG` come through the same checks."""


def all_settings_classes() -> Iterator[type]:
    """Every settings class of the package, reached by a command or not."""
    for module in pkgutil.walk_packages(sst_graph.__path__, "sst_graph."):
        members = vars(importlib.import_module(module.name)).items()
        for name, cls in members:
            if inspect.isclass(cls) and cls.__module__ == module.name and name.endswith("Config"):
                yield cls


CLASSES = sorted(all_settings_classes(), key=lambda cls: cls.__name__)


def own_settings(root: Any) -> list[tuple[str, Any, Any]]:
    """Name, field and type of a command's settings; of those that ``calibrate`` has, too, one in twenty."""
    found = list(walk_settings(type(root)))
    shared = [entry for entry in found if entry[0].startswith("calibration.")]
    return [entry for entry in found if entry not in shared] + shared[::20]


def numeric(hint: Any) -> bool:
    """Whether numbers may stand in a setting of a type."""
    return hint in (int, float) or any(numeric(part) for part in get_args(hint))


def test_there_are_settings_to_look_at() -> None:
    assert {type(root) for root in ROOTS.values()} <= set(CLASSES)
    assert all(any(walk_settings(type(root))) for root in ROOTS.values())


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_every_class_of_settings_checks_its_fields(cls: type) -> None:
    assert issubclass(cls, Settings) and dataclasses.is_dataclass(cls)


@pytest.mark.parametrize("root", [*CLASSES, *map(type, ROOTS.values())], ids=lambda cls: cls.__name__)
def test_every_number_has_a_range_and_a_default_within_it(root: Any) -> None:
    for name, field, hint in walk_settings(root):
        bounds = Range.of(field)
        if numeric(hint):
            assert bounds.low is not None and bounds.high is not None and bounds.low < bounds.high, name
        if get_args(hint) and get_args(hint)[-1] is Ellipsis and numeric(hint):
            assert bounds.length is not None, name
    assert root() == root(**{field.name: getattr(root(), field.name) for field in dataclasses.fields(root)})


def tree(name: str, value: Any) -> dict[str, Any]:
    for key in reversed(name.split(".")):
        value = {key: value}
    assert isinstance(value, dict)
    return value


def refused(name: str, value: Any, message: str) -> bool:
    """False, after a look at the error: one short line that names the setting, or rules beside it."""
    table, _, last = name.rpartition(".")
    named = message.startswith(name) or f"'{name}" in message
    assert named or (message.startswith(table) and last in message), (name, value, message)
    assert message.isprintable() and len(message) < 300, (name, value, message)
    return False


def accepted(root: Any, name: str, value: Any) -> bool:
    try:
        config = from_dict(type(root), tree(name, value))
    except ConfigError as error:
        return refused(name, value, str(error))
    # What is accepted can be written out and read again.
    written = json.dumps(to_dict(config), allow_nan=False)
    assert from_dict(type(root), json.loads(written)) == config
    return True


@pytest.mark.parametrize("command", ROOTS)
def test_a_wrong_value_in_a_dictionary_is_refused_by_its_name(command: str) -> None:
    root = ROOTS[command]
    for name, field, hint in own_settings(root):
        outside = [value for value in WRONG if not accepted(root, name, value)]
        assert any(value is True for value in outside) or hint is bool
        if numeric(hint):
            bounds = Range.of(field)
            for value in (bounds.low - 1, bounds.high + 1, 10**400, float("nan"), float("inf"), "1", None):
                alone = [value] * len(get_args(hint)) if get_args(hint) else value
                assert not accepted(root, name, alone), (name, value)


@pytest.mark.parametrize("command", ROOTS)
def test_the_bounds_themselves_are_taken(command: str) -> None:
    root, beside = ROOTS[command], []
    for name, field, hint in own_settings(root):
        if hint not in (int, float):
            continue
        bounds = Range.of(field)
        for bound, is_open in ((bounds.low, bounds.open_low), (bounds.high, bounds.open_high)):
            if accepted(root, name, hint(bound)) == is_open:
                beside.append(name)
    # Only where another setting beside it says more.
    assert {name.rpartition(".")[2] for name in beside} <= {
        *("frames", "width", "height", "speed_mps", "frame_rate_hz", "streets", "time_offset_s"),
        *("window", "start_scans", "kept"),
        *("search_m", "search_step_m"),
        *("first_px", "last_px"),
        *("min_voxel_m", "max_voxel_m", "near_m", "far_m", "min_points", "max_points"),
    }


@pytest.mark.parametrize("command", ["calibrate", "track", "simulate"])
def test_wrong_texts_of_set_are_refused_by_the_name(command: str) -> None:
    root = ROOTS[command]
    for name, _, _ in own_settings(root):
        for text in TEXTS:
            try:
                with_overrides(root, [f"{name}={text}"])
            except ConfigError as error:
                refused(name, text, str(error))


@pytest.mark.parametrize("command", ["calibrate", "track", "simulate"])
def test_wrong_values_in_files_are_refused_by_file_and_name(command: str, tmp_path: Path) -> None:
    path = tmp_path / "settings.json"
    for name, _, _ in own_settings(ROOTS[command]):
        for text in ("-1e300", "NaN", "Infinity", '"\\ud800"', "[[]]", "1" + "0" * 400):
            path.write_text(json.dumps(tree(name, "VALUE")).replace('"VALUE"', text))
            with pytest.raises(SstGraphError) as caught:
                read_config(type(ROOTS[command]), path)
            found = str(caught.value)
            assert found.startswith(f"{path}: ") and (name in found or "found no JSON" in found)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ("calibration.search.rotation_deg=60", ""),
        ("calibration.noise.object_bias_sigma_px=0", ""),
        ("calibration.noise.object_bias_sigma_px=1e-9", "found 1e-09, expected 0 or at least 0.001 px"),
        (
            "calibration.search.time_offset_s=6",
            "calibration.search.time_offset_s: found 6, expected at least 0 and at most 5 s",
        ),
        ("calibration.lidar_odometry.near_m=100", ""),
        ("calibration.lidar_odometry.far_m=1", ""),
        (
            'calibration.lidar_odometry={"near_m": 60, "far_m": 50}',
            r"near_m: found 60, expected at most 50 m \(far_m\)",
        ),
        ("window=10", r"^window: found 10, expected at least 12 \(start_scans\)"),
    ],
)
def test_rules_between_settings(settings: str, message: str) -> None:
    if not message:
        with_overrides(TrackerConfig(), [settings])
        return
    with pytest.raises(ConfigError, match=message):
        with_overrides(TrackerConfig(), [settings])


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("joint.max_outer=0", "unknown setting 'joint.max_outer'; it is fixed in sst_graph.graph.outer_loop"),
        ("alarm.lost=3", "unknown setting 'alarm.lost'; it is fixed in sst_graph.tracker.monitor"),
        ("noise.lower_edges=[vehicle]", "unknown setting 'noise.lower_edges'"),
        ("noise.estimate=[focal]", "unknown setting 'noise.estimate'"),
        ("search.seed=1", "unknown setting 'search.seed'; did you mean 'seed'?"),
        ("seed=-1", "seed: found -1, expected at least 0"),
        ("lidar_odometry.voxel_m=0", "voxel_m: found 0, expected at least 0.02 and at most 10 m"),
        ("paper.static_frames=0", "paper.static_frames: found 0, expected at least 1"),
        (
            "lower_edges=sometimes",
            "lower_edges: found 'sometimes', expected one of auto, always, never",
        ),
        ("foo=1", "unknown setting 'foo'; no setting has a name like it; known at the top: assumptions, "),
        ("voxel_m=3", "unknown setting 'voxel_m'; did you mean 'lidar_odometry.voxel_m'?"),
    ],
)
def test_what_no_method_can_work_with_is_refused_with_its_bounds(setting: str, message: str) -> None:
    with pytest.raises(ConfigError, match="^.*" + message.replace("?", r"\?")):
        with_overrides(CalibrationConfig(), [setting])


@pytest.mark.slow
def test_the_bounds_of_some_settings_end_in_a_result_or_a_typed_error() -> None:
    """A sample of what ``checks/settings_walk.py`` goes through."""
    quick = [case for case in cases() if not case.settings[-1].startswith("search.")]
    chosen = np.random.default_rng(8).choice(len(quick), 8, replace=False)
    worker = Worker(seconds=60.0, memory_gb=4.0)
    try:
        ends = {quick[i].settings[-1]: worker.run(quick[i]) for i in chosen}
    finally:
        worker.stop()
    assert {name: end for name, (well, end) in ends.items() if not well} == {}
    assert any(end in get_args(Status) for _, end in ends.values())
