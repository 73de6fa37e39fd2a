"""The motion experiment: a row by hand, settings that make no sense."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
import pytest

from sst_graph.errors import ConfigError
from sst_graph.experiments import motion
from sst_graph.experiments.motion import MotionRun, MotionTableConfig
from sst_graph.experiments.registry import EXPERIMENTS
from sst_graph.experiments.starts import start_near
from sst_graph.metrics import CalibrationErrors, Nees


def outcome(run: str, qad_deg: float, time_offset_s: float, status: str = "ok") -> MotionRun:
    return MotionRun(
        run, CalibrationErrors(qad_deg, qad_deg, 0.02, time_offset_s, Nees(6.0, 3.0, 2.0, 1.0)), status, 1.5
    )


def test_a_row_by_hand() -> None:
    row = motion._row(
        "turning", "joint", [outcome("joint", 0.1, -0.002), outcome("joint", 0.3, 0.004, "unobservable")]
    )
    assert " | ".join(row) == (
        "turning | joint | 0.200 / 0.300 | 2.00 / 2.00 | 3.00 / 4.00 | 3.0, 2.0, 6.0 | 1 / 1 / 0 | 1.5"
    )


def test_every_drive_and_run_has_its_row() -> None:
    seen: list[tuple[str, int]] = []

    def outcomes(config: MotionTableConfig, name: str, number: int) -> list[MotionRun]:
        seen.append((name, number))
        return [outcome(label, 0.1 * (number + 1), 0.001) for label in motion.RUNS]

    steps: list[tuple[str, int, int]] = []
    table = motion.run(MotionTableConfig(streets=2), lambda *step: steps.append(step), outcomes)
    assert len(table.splitlines()) == 2 + len(motion.DRIVES) * len(motion.RUNS)
    assert len(seen) == len(steps) == 2 * len(motion.DRIVES)
    assert {line.count("|") for line in table.splitlines()} == {9}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"drives": ("flying",)}, r"drives\[0\]: found 'flying', expected one of turning"),
        ({"drives": ()}, "drives: found .* expected a list of 1 to 100 values"),
        ({"streets": 0}, "streets: found 0, expected at least 1"),
        (
            {"streets": 40},
            "streets: found 40 whose offsets grow from time_offset_s .* expected offsets of at most 0.5 s",
        ),
    ],
)
def test_settings_that_make_no_sense(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        MotionTableConfig(**wrong)


def test_starts_are_seeded_and_within_bounds() -> None:
    config = EXPERIMENTS["motion"].config
    poses = [
        start_near(gtsam.Pose3(), config.start_deg, config.start_m, np.random.default_rng(3))
        for _ in range(2)
    ]
    assert poses[0].equals(poses[1], 1e-12)
    log = gtsam.Rot3.Logmap(poses[0].rotation())
    assert 0.0 < np.degrees(np.abs(log).max()) <= config.start_deg
