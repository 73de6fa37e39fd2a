"""Strict configuration: dictionaries, files, overrides."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest

from sst_graph.config import from_dict, read_config, to_dict, with_overrides
from sst_graph.errors import ConfigError, DataError
from sst_graph.types import SemanticClass


@dataclass(frozen=True)
class Inner:
    sigma_px: float = 1.5
    schedule: tuple[tuple[float, int], ...] = ((20.0, 20), (1.0, 30))

    def __post_init__(self) -> None:
        if self.sigma_px <= 0.0:
            raise ValueError(f"sigma_px: found {self.sigma_px}, expected more than 0")


@dataclass(frozen=True)
class Outer:
    method: Literal["joint", "paper"] = "joint"
    iterations: int = 20
    robust: bool = True
    limit_m: float | None = None
    classes: tuple[SemanticClass, ...] = (SemanticClass.VEHICLE,)
    window: tuple[int, int] = (0, 5)
    inner: Inner = field(default_factory=Inner)


def test_round_trip_through_json() -> None:
    config = Outer(
        "paper", 3, False, 2.5, (SemanticClass.POLE, SemanticClass.VEHICLE), (1, 2), Inner(0.5, ())
    )
    assert from_dict(Outer, json.loads(json.dumps(to_dict(config)))) == config


def test_what_is_not_named_keeps_its_default() -> None:
    assert from_dict(Outer, {"inner": {"sigma_px": 3}}) == Outer(inner=Inner(sigma_px=3.0))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"iteration": 3}, "unknown setting 'iteration'; did you mean 'iterations'?"),
        ({"inner": {"sigma": 3}}, "unknown setting 'inner.sigma'; did you mean 'sigma_px'?"),
        ({"xyz": 3}, "unknown setting 'xyz'; known: classes, inner"),
        ({"iterations": 3.5}, "'iterations': found 3.5, expected a whole number"),
        ({"iterations": True}, "'iterations': found True, expected a whole number"),
        ({"robust": 1}, "'robust': found 1, expected true or false"),
        ({"method": "magic"}, "'method': found 'magic', expected one of joint, paper"),
        ({"limit_m": "far"}, "'limit_m': found 'far', expected a number"),
        ({"classes": ["vehicle", "ufo"]}, r"'classes\[1\]': found 'ufo', expected one of other, vehicle"),
        ({"classes": "vehicle"}, "'classes': found 'vehicle', expected a list"),
        ({"window": [1, 2, 3]}, "'window': found .* expected a list of 2 values"),
        ({"inner": 3}, "'inner': found 3, expected a table of sigma_px, schedule"),
        ({"inner": {"sigma_px": -1}}, "inner: sigma_px: found -1.0, expected more than 0"),
        ({"inner": {"sigma_px": float("nan")}}, "'inner.sigma_px': found nan, expected a finite number"),
    ],
)
def test_refused(data: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        from_dict(Outer, data)


def test_overrides_are_applied_in_turn() -> None:
    config = with_overrides(
        Outer(),
        ["method=paper", "inner.sigma_px=2", "inner.sigma_px=4e-1", 'classes=["pole"]', "limit_m=null"],
    )
    assert config == Outer(method="paper", classes=(SemanticClass.POLE,), inner=Inner(sigma_px=0.4))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("iterations", "expected name=value"),
        ("=3", "expected name=value"),
        ("inner.sigm_px=3", "unknown setting 'inner.sigm_px'; did you mean 'sigma_px'?"),
        ("iterations.x=3", "iterations is a single value"),
        ("inner.sigma_px=-1", "inner.sigma_px: sigma_px: found -1.0"),
        ("robust=perhaps", "found 'perhaps', expected true or false"),
    ],
)
def test_override_refused(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        with_overrides(Outer(), [override])


def test_files(tmp_path: Path) -> None:
    toml, json_file = tmp_path / "a.toml", tmp_path / "a.json"
    toml.write_text('method = "paper"\n[inner]\nsigma_px = 2\n')
    json_file.write_text('{"method": "paper", "inner": {"sigma_px": 2}}')
    assert read_config(Outer, toml) == read_config(Outer, json_file) == Outer("paper", inner=Inner(2.0))


@pytest.mark.parametrize(
    ("name", "content", "kind", "message"),
    [
        ("a.yaml", b"", DataError, "suffix '.yaml', expected .json or .toml"),
        ("a.json", b"{", DataError, "a.json"),
        ("a.json", b"\xff\xfe", DataError, "a.json"),
        ("a.json", b"[1]", DataError, "found list, expected a table"),
        ("a.toml", b"x = = 3", DataError, "a.toml"),
        ("a.toml", b"iteration = 3", ConfigError, "a.toml: unknown setting 'iteration'"),
    ],
)
def test_bad_file(tmp_path: Path, name: str, content: bytes, kind: type[Exception], message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(kind, match=message) as caught:
        read_config(Outer, tmp_path / name)
    assert "\n" not in str(caught.value)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        read_config(Outer, tmp_path / "none.toml")
