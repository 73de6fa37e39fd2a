"""The table of SLAM and calibration together: what it holds, and a small street end to end."""

from __future__ import annotations

import dataclasses

import pytest

from sst_graph.errors import ConfigError
from sst_graph.experiments.registry import experiment
from sst_graph.experiments.slam import MEASURES, SlamConfig, SlamRun, markdown, solve_street
from sst_graph.simulator import SimulationConfig


def street(weather: str, alone: float, both: float) -> SlamRun:
    poses, calibration = list(MEASURES)[:3], list(MEASURES)[3:]
    return SlamRun(
        weather,
        3,
        {
            "odometry": dict.fromkeys(poses, 9.0),
            "SLAM alone": dict.fromkeys(poses, alone),
            "calibration alone": dict.fromkeys(calibration, alone),
            "both": dict.fromkeys(MEASURES, both),
        },
    )


def test_the_table_holds_medians_and_counts_the_better() -> None:
    streets = [street("fog", 2.0, 1.0), street("fog", 4.0, 5.0), street("fog", 6.0, 3.0)]
    lines = markdown(SlamConfig(weathers=("fog",)), streets).splitlines()
    assert len(lines) == 2 + 5 and all(line.count("|") == lines[0].count("|") for line in lines)
    assert lines[2] == "| fog | odometry | 9.00 | 9.000 | 9.00 |  |  |  |"
    assert lines[3] == "| fog | SLAM alone | 4.00 | 4.000 | 4.00 |  |  |  |"
    assert lines[5] == "| fog | both | 3.00 | 3.000 | 3.00 | 3.000 | 3.00 | 3.00 |"
    assert lines[6] == "| fog | both better | " + " | ".join(["2 of 3"] * 6) + " |"


@pytest.mark.slow
def test_a_small_street() -> None:
    config = dataclasses.replace(
        SlamConfig(),
        frames=11,
        street=SimulationConfig(
            width=621,
            height=188,
            motion="there_and_back",
            azimuth_step_deg=0.6,
            vehicle_density=0.3,
            moving_fraction=0.0,
        ),
        loop_every=3,
        loop_min_s=0.4,
    )
    found = solve_street(config, "fog", 4)
    assert found.closures >= 3
    both, alone = found.errors["both"], found.errors["SLAM alone"]
    assert set(both) == set(MEASURES)
    assert both["step translation [cm]"] < 0.9 * alone["step translation [cm]"]
    assert both["position [cm]"] < 1.2 * alone["position [cm]"] and both["rotation [deg]"] < 1.0


def test_refuses_weathers_that_it_does_not_know() -> None:
    assert experiment("slam").config == SlamConfig()
    with pytest.raises(ConfigError, match="hail"):
        SlamConfig(weathers=("hail",))
    with pytest.raises(ConfigError, match="streets: found 0, expected at least 1"):
        SlamConfig(streets=0)
