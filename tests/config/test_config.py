"""Strict configuration: declared ranges, dictionaries, files, overrides."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from sst_graph.config import (
    Range,
    Settings,
    from_dict,
    read_config,
    setting,
    to_dict,
    walk_settings,
    with_overrides,
)
from sst_graph.errors import ConfigError, DataError, SstGraphError
from sst_graph.files.reading import SETTINGS
from sst_graph.types import SemanticClass


@dataclass(frozen=True)
class Inner(Settings):
    sigma_px: float = setting(1.5, more_than=0.0, at_most=100.0)
    schedule: tuple[tuple[float, int], ...] = setting(
        ((20.0, 20), (1.0, 30)), at_least=0, at_most=50, length=(0, 3)
    )
    weights: tuple[float, ...] = setting((1.0,), at_least=0.0, at_most=9.0, length=(1, 4))
    steps: tuple[int, ...] = setting((1,), at_least=1, at_most=9, length=(1, 4))

    def __post_init__(self) -> None:
        if len(self.weights) != len(self.steps):
            raise ValueError(f"weights: found {len(self.weights)} of them, expected one for each of steps")


@dataclass(frozen=True)
class Outer(Settings):
    method: Literal["joint", "paper"] = "joint"
    iterations: int = setting(20, at_least=1, less_than=1000)
    robust: bool = True
    limit_m: float | None = setting(None, at_least=0.0, at_most=10.0)
    classes: tuple[SemanticClass, ...] = (SemanticClass.VEHICLE,)
    window: tuple[int, int] = setting((0, 5), at_least=0, at_most=9, order="increasing")
    names: tuple[str, ...] = setting((), choices=("fog", "clear"))
    title: str = ""
    inner: Inner = field(default_factory=lambda: Inner(sigma_px=2.5))


def test_round_trip_through_json() -> None:
    config = Outer(
        method="paper",
        iterations=3,
        robust=False,
        limit_m=2.5,
        classes=(SemanticClass.POLE, SemanticClass.VEHICLE),
        window=(1, 2),
        names=("fog",),
        inner=Inner(0.5, ()),
    )
    assert from_dict(Outer, json.loads(json.dumps(to_dict(config)))) == config


def test_what_is_not_named_keeps_its_default_in_nested_tables_too() -> None:
    assert from_dict(Outer, {"inner": {"steps": [2]}}) == Outer(inner=Inner(sigma_px=2.5, steps=(2,)))


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"iterations": 3.5}, "iterations: found 3.5, expected a whole number, at least 1 and less than 1000"),
    ({"iterations": True}, "iterations: found True, expected a whole number, at least 1 and less than 1000"),
    ({"iterations": None}, "iterations: found None, expected a whole number"),
    ({"iterations": ""}, "iterations: found '', expected a whole number"),
    ({"iterations": 0}, "iterations: found 0, expected at least 1 and less than 1000"),
    ({"iterations": 1000}, "iterations: found 1000, expected at least 1 and less than 1000"),
    ({"iterations": 10**400}, "iterations: found an integer of 1329 bits, expected at least 1 and less than"),
    ({"iterations": 10**5000}, "iterations: found an integer of 16610 bits, expected at least 1"),
    ({"robust": 1}, "robust: found 1, expected true or false"),
    ({"method": "magic"}, "method: found 'magic', expected one of joint, paper"),
    ({"method": ["joint"]}, r"method: found \['joint'\], expected one of joint, paper"),
    ({"limit_m": "far"}, "limit_m: found 'far', expected a number, at least 0 and at most 10 m"),
    ({"limit_m": -1e-300}, "limit_m: found -1e-300, expected at least 0 and at most 10 m"),
    ({"limit_m": float("inf")}, "limit_m: found inf, expected a finite number, at least 0 and at most 10 m"),
    ({"limit_m": 10**400}, "limit_m: found an integer of 1329 bits, expected at least 0 and at most 10 m"),
    ({"classes": ["vehicle", "ufo"]}, r"classes\[1\]: found 'ufo', expected one of other, vehicle"),
    ({"classes": "vehicle"}, "classes: found 'vehicle', expected a list"),
    ({"window": [1, 2, 3]}, r"window: found \[1, 2, 3\], expected a list of 2 values"),
    ({"window": [3, 3]}, r"window: found \[3, 3\], expected increasing values"),
    ({"window": [3, 10]}, r"window\[1\]: found 10, expected at least 0 and at most 9"),
    ({"names": ["fog", "snow"]}, r"names\[1\]: found 'snow', expected one of fog, clear"),
    ({"title": "a\nb"}, "title: found 'a.nb', expected text without control characters"),
    ({"title": "\ud800"}, "title: found .*ud800', expected text without control characters, in UTF-8"),
    ({"inner": 3}, "inner: found 3, expected a table of sigma_px, schedule"),
    ({"inner": {"sigma_px": -1}}, "inner.sigma_px: found -1, expected more than 0 and at most 100 px"),
    ({"inner": {"sigma_px": 0}}, "inner.sigma_px: found 0, expected more than 0 and at most 100 px"),
    ({"inner": {"sigma_px": float("nan")}}, "inner.sigma_px: found nan, expected a finite number, more than"),
    ({"inner": {"schedule": [[1, 2], [3, 51]]}}, r"inner.schedule\[1\]\[1\]: found 51, expected at least 0"),
    ({"inner": {"schedule": [[1, 2]] * 4}}, "inner.schedule: found .* expected a list of 0 to 3 values"),
    ({"inner": {"weights": []}}, r"inner.weights: found \[\], expected a list of 1 to 4 values"),
    ({"inner": {"steps": [1, 2]}}, "inner.weights: found 1 of them, expected one for each of steps"),
]


@pytest.mark.parametrize(("data", "message"), WRONG)
def test_a_wrong_value_is_refused_in_a_dictionary(data: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match="^" + message):
        from_dict(Outer, data)


@pytest.mark.parametrize(("data", "message"), [(d, m) for d, m in WRONG if "inner" not in d])
def test_a_wrong_value_is_refused_by_the_constructor(data: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match="^Outer." + message):
        Outer(**data)
    with pytest.raises(ConfigError, match="^Outer." + message):
        dataclasses.replace(Outer(), **data)


def test_a_rule_that_spans_fields_is_kept_by_the_constructor() -> None:
    with pytest.raises(ConfigError, match=r"^weights: found 1 of them"):
        Inner(steps=(1, 2))


def test_the_constructor_stores_the_declared_types() -> None:
    config = Outer(iterations=np.int64(3), limit_m=2, window=[1, 2])  # type: ignore[arg-type]
    assert to_dict(config) == to_dict(Outer(iterations=3, limit_m=2.0, window=(1, 2)))
    assert [type(config.iterations), type(config.limit_m), type(config.window)] == [int, float, tuple]


def test_the_range_of_a_field_in_words() -> None:
    texts = {name: Range.of(field).text() for name, field, _ in walk_settings(Outer)}
    assert texts["inner.sigma_px"] == "more than 0 and at most 100 px"
    assert texts["iterations"] == "at least 1 and less than 1000"
    assert texts["robust"] == ""
    assert list(texts)[-4:] == ["inner.sigma_px", "inner.schedule", "inner.weights", "inner.steps"]


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("iteration", "did you mean 'iterations'?"),
        ("inner.sigma", "did you mean 'inner.sigma_px'?"),
        ("inner.sigm_px", "did you mean 'inner.sigma_px'?"),
        ("sigma_px", "did you mean 'inner.sigma_px'?"),
        ("calibration.inner.sigma_px", "did you mean 'inner.sigma_px'?"),
        ("calibration.inner.sigmapx", "did you mean 'inner.sigma_px'?"),
        ("robsut", "did you mean 'robust'?"),
        ("foo", "no setting has a name like it; known at the top: classes, inner, iterations, limit_m"),
        ("a", "no setting has a name like it"),
        ("x" * 10_000, "no setting has a name like it"),
        ("inner.\x1b[31m\n", "no setting has a name like it"),
    ],
)
def test_an_unknown_name_is_refused_with_the_nearest_of_the_whole_tree(name: str, hint: str) -> None:
    nested: Any = 3
    for key in reversed(name.split(".")):
        nested = {key: nested}
    for refused in (lambda: with_overrides(Outer(), [f"{name}=3"]), lambda: from_dict(Outer, nested)):
        with pytest.raises(ConfigError, match="unknown setting") as caught:
            refused()
        assert hint in str(caught.value)
        assert str(caught.value).isprintable() and len(str(caught.value)) < 400


def test_overrides_are_applied_in_turn() -> None:
    config = with_overrides(
        Outer(),
        ["method=paper", "inner.sigma_px=2", "inner.sigma_px=4e-1", 'classes=["pole"]', "limit_m=null"],
    )
    assert config == Outer(method="paper", classes=(SemanticClass.POLE,), inner=Inner(sigma_px=0.4))


def test_a_table_as_override_changes_what_it_names() -> None:
    assert with_overrides(Outer(), ['inner={"steps": [3]}', "inner.sigma_px=2"]) == Outer(
        inner=Inner(sigma_px=2.0, steps=(3,))
    )


def test_rules_that_span_fields_see_all_overrides_at_once() -> None:
    config = with_overrides(Outer(), ["inner.weights=[1,2]", "inner.steps=[3,4]"])
    assert config.inner.steps == (3, 4)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("iterations", "expected name=value"),
        ("=3", "expected name=value"),
        ("iterations.x=3", "iterations is a single value"),
        ("inner.sigma_px=-1", "inner.sigma_px: found -1, expected more than 0"),
        ("inner=3", "inner: found 3, expected a table"),
        ("inner.steps=[1,2]", "inner.weights: found 1 of them"),
        ("robust=perhaps", "found 'perhaps', expected true or false"),
        ("iterations=" + "9" * 5000, "iterations: found '9999.*of 5000 characters, expected"),
        ("limit_m=1e999999999", "limit_m: found inf, expected a finite number"),
        ("inner.steps=" + "[" * 100_000, "inner.steps: found .* of 100000 characters"),
        ("title=a\udcffb", "title: found .*expected text without control characters, in UTF-8"),
    ],
)
def test_override_refused(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        with_overrides(Outer(), [override])
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


def test_files(tmp_path: Path) -> None:
    toml, json_file = tmp_path / "a.toml", tmp_path / "a.json"
    toml.write_text('method = "paper"\n[inner]\nsigma_px = 2\n')
    json_file.write_text('{"method": "paper", "inner": {"sigma_px": 2}}')
    assert read_config(Outer, toml) == read_config(Outer, json_file) == Outer("paper", inner=Inner(2.0))


@pytest.mark.parametrize(
    ("name", "content", "kind", "message"),
    [
        ("a.yaml", b"", DataError, "suffix '.yaml', expected .json or .toml"),
        ("a.json", b"", DataError, "a.json"),
        ("a.json", b"{", DataError, "a.json"),
        ("a.json", b"\xff\xfe", DataError, "a.json"),
        ("a.toml", b"title = '\xff'", DataError, "a.toml"),
        ("a.json", b"[1]", DataError, "found list, expected a table"),
        ("a.json", b'{"title": "\\ud800"}', DataError, "a.json: found"),
        ("a.json", b'{"\\ud800": 3}', DataError, "a.json: found"),
        ("a.json", b'{"limit_m": 1e999999999}', DataError, "a.json: found"),
        ("a.json", b'{"limit_m": 1' + b"0" * 5000 + b"}", DataError, "a.json"),
        ("a.toml", b"limit_m = 1" + b"0" * 5000, DataError, "a.toml"),
        ("a.toml", b"limit_m = 1" + b"0" * 400, DataError, "a.toml: found"),
        ("a.toml", b"limit_m = 1979-05-27", ConfigError, "limit_m: found .* expected a number"),
        ("a.json", b'{"inner":' * 10_000, DataError, "a.json: found .* nested too deep"),
        ("a.json", b'{"window": ' + b"[" * 100_000, DataError, "a.json: found .* nested too deep"),
        ("a.toml", b"window = " + b"[" * 100_000, DataError, "a.toml: found .* nested too deep"),
        ("a.json", b'{"window": ' + b"[" * 900 + b"]" * 900 + b"}", DataError, "nested too deep"),
        ("a.json", b" " * (SETTINGS.max_bytes + 1), DataError, "a.json: found 262145 bytes"),
        ("a.toml", b"x = = 3", DataError, "a.toml"),
        ("a.toml", b"iteration = 3", ConfigError, "a.toml: unknown setting 'iteration'"),
    ],
)
def test_bad_file(tmp_path: Path, name: str, content: bytes, kind: type[Exception], message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(kind, match=message) as caught:
        read_config(Outer, tmp_path / name)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400 + len(str(tmp_path))


@pytest.mark.parametrize(("make", "kind"), [(os.mkfifo, "a FIFO"), (os.mkdir, "a folder")])
def test_what_is_no_file_is_refused(tmp_path: Path, make: Callable[[Path], None], kind: str) -> None:
    make(tmp_path / "a.json")
    with pytest.raises(DataError, match=f"a.json: found {kind}"):
        read_config(Outer, tmp_path / "a.json")


def test_a_link_that_leads_round_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.json").symlink_to(tmp_path / "a.json")
    with pytest.raises(DataError, match=r"a.json: found"):
        read_config(Outer, tmp_path / "a.json")


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        read_config(Outer, tmp_path / "none.toml")


def test_an_error_of_the_settings_is_both_ours_and_a_value_error() -> None:
    assert issubclass(ConfigError, SstGraphError) and issubclass(ConfigError, ValueError)
