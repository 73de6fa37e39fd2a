"""A sweep that the scans leave undecided, or that is not as was said: one rule for tracker and batch."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import streets
from stored import simulated, written

from sst_graph import CalibrationConfig, Tracker, TrackerConfig, calibrate
from sst_graph.cli import main
from sst_graph.config import with_overrides
from sst_graph.covariance.undecided_sweep import MATTERS, SweepEffect
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.odometry.sweep import SweepDecision, SweepTiming, SweptSource, with_sweep

TIMING = SweepTiming(0.0, -np.pi, 0.1)
BOTH = (replace(TIMING, fraction=-1.0), replace(TIMING, fraction=1.0))
OPEN = SweepDecision("undecided", TIMING, 0.1, 0.4, others=BOTH)
SLOW = replace(streets.SHORT_STREET, speed_mps=1.7)
"""In a narrow view too slow a drive to show whether it is compensated."""
WIDE = ["observability.time_offset_s=0.1", "observability.translation_m=0.2"]
"""It determines the time offset to some 10 ms, the translation to some 5 cm, whatever the sweep."""
SOON = [*streets.SOON, *(f"calibration.{setting}" for setting in WIDE)]
OPTIONS = [word for setting in SOON for word in ("--set", setting)]


def test_the_mean_square_of_the_changes_is_added_and_said_where_it_matters() -> None:
    covariance = np.diag(np.full(7, 1e-4))
    step = np.zeros(7)
    step[3] = 0.03
    found = SweepEffect.of(OPEN, {-1.0: step, 1.0: -step}, covariance)
    # No hypothesis fits worse: a third each, two of which move the estimate.
    assert found.covariance[3, 3] == pytest.approx(2.0 / 3.0 * 9e-4)
    assert "it matters: 0.00 deg, 3.0 cm, 0.0 ms" in found.sentence
    small = SweepEffect.of(OPEN, {-1.0: 0.1 * step, 1.0: -0.1 * step}, covariance)
    assert small.covariance[3, 3] > 0.0 and small.sentence == ""
    decided = SweepEffect.of(replace(OPEN, kind="clockwise"), {-1.0: step}, covariance)
    assert not decided.covariance.any() and decided.sentence == ""


@pytest.mark.slow
def test_tracker_and_batch_agree_about_it(tmp_path: Path) -> None:
    drive = KeptDrive.of(simulated(SLOW), sweep="auto")
    source = with_sweep(drive)
    decision = source.sweep_decision
    assert decision.kind == "undecided" and len(decision.others) == 2
    trackers = []
    for of_sweep in (None, decision):
        config = with_overrides(TrackerConfig(), SOON)
        tracker = Tracker(drive.camera, config, drive.nominal, sweep=of_sweep)
        lines = [tracker.add(frame) for frame in drive]
        trackers.append((tracker, lines, tracker.optimize()))
    (_, _, plain), (tracker, lines, last) = trackers
    assert plain.undecided_sweep == "" and plain.covariance is not None and last.covariance is not None
    assert last.status == "unconfirmed" and "it matters" in last.undecided_sweep
    # No line is ok, the last as little as any other; it is one rule for all.
    assert not [line for line in lines if line.covariance is not None and line.status == "ok"]
    result = tracker.result()
    assert result.status == "unobservable" and result.reasons == (last.undecided_sweep,)
    # As much as the batch finds by solving again.
    settings = with_overrides(CalibrationConfig(), ["search.enabled=false", "use_motion=never", *WIDE])
    batch = calibrate(source, drive.nominal, settings)
    alone = calibrate(SweptSource(drive, SweepDecision("given", TIMING)), drive.nominal, settings)
    by_batch = np.sqrt(np.diag(batch.covariance - alone.covariance))
    share = float((by_batch / np.sqrt(np.diag(batch.covariance))).max())
    assert share > MATTERS and batch.status == "unobservable"
    assert any("it matters" in reason for reason in batch.reasons)
    by_tracker = np.sqrt(np.diag(last.covariance - plain.covariance))
    # Forward and time offset, which a sweep at constant speed moves, and yaw.
    np.testing.assert_allclose(by_tracker[[2, 3, 6]], by_batch[[2, 3, 6]], rtol=0.5)
    # A checkpoint keeps it.
    path = tmp_path / "tracker.npz"
    tracker.save(path)
    again = Tracker.load(path)
    assert again.estimate.sweep == decision
    assert again.result().reasons == result.reasons
    # Unless another was made for the scans to come, as by the command that resumes it.
    given = SweepDecision("given", TIMING)
    told = Tracker.load(path, sweep=given)
    assert told.estimate.sweep == given and told.result().reasons == ()


@pytest.mark.slow
def test_no_line_of_track_is_ok_where_the_sweep_is_open(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "calibration.json"
    for how, code in ((["--sweep", "auto"], 3), (["--sweep", "compensated"], 0)):
        assert main(["track", str(written(SLOW)), *OPTIONS, *how, "--out", str(out), "--overwrite"]) == code
        lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        result = json.loads(out.read_text())
        (sweep,) = result["diagnostics"]["sweep"].values()
        if code == 0:
            assert lines[-1]["status"] == result["status"] == "ok" and sweep["kind"] == "given"
            continue
        assert sweep["kind"] == "undecided" and result["status"] == "unobservable"
        assert lines[-1]["undecided_sweep"] in result["reasons"]
        assert not any(line["status"] == "ok" for line in lines)


@pytest.mark.slow
def test_no_line_is_ok_where_the_scans_contradict_what_was_said_of_them() -> None:
    drive = simulated(SLOW)
    found = replace(OPEN, kind="clockwise", timing=BOTH[0], others=())
    said = found.given_as("compensated")
    assert said.contradiction and not found.given_as("azimuth").contradiction
    config = with_overrides(TrackerConfig(), streets.SOON)
    tracker = Tracker(drive.camera, config, drive.nominal, sweep=said)
    lines = [tracker.add(frame) for frame in drive]
    assert all(line.contradictions == (said.contradiction,) for line in lines)
    assert {line.status for line in lines} == {"starting", "contradicted"}
    assert tracker.result().reasons[0] == said.contradiction
