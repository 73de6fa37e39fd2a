"""The sweep, decided from the scans: its model, the registration behind it, sources that carry it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stored import simulated
from streets import prepared_street, standing_street

from sst_graph import CalibrationConfig, open_source
from sst_graph.batch.causes import with_causes
from sst_graph.cli import main
from sst_graph.drive.geometric_labels import labelled_by_geometry
from sst_graph.errors import ConfigError
from sst_graph.odometry.sweep import (
    SWEEP_KEY,
    SweepDecision,
    SweptSource,
    decide_sweep,
    with_sweep,
    with_sweep_of,
)
from sst_graph.odometry.sweep.estimate import CANDIDATES, SweepEvidence, estimate
from sst_graph.odometry.sweep.given_times import turn_of
from sst_graph.odometry.sweep.window import SECTORS, SweepWindow
from sst_graph.result import CalibrationResult, FrameId
from sst_graph.simulator import SimulatedDrive, SimulationConfig, simulate, write_drive
from sst_graph.sweep_timing import SweepTiming
from sst_graph.types import Frame, Guess, Scan
from studies.edges_streets import source_of
from studies.sweep import decided, street

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
PARKED = DATA / "kitti_2011_09_26_parked"


STREET = SimulationConfig(
    seed=302,
    frames=14,
    width=621,
    height=188,
    motion="no_stop",
    speed_mps=8.0,
    rolling=True,
    azimuth_step_deg=0.4,
    azimuth_limit_deg=60.0,
)


# --- the model -----------------------------------------------------------------------------------


def _towards(*azimuths_deg: float) -> np.ndarray[Any, np.dtype[np.float32]]:
    azimuth = np.radians(azimuths_deg)
    return np.column_stack([9.0 * np.cos(azimuth), 9.0 * np.sin(azimuth), 0.0 * azimuth]).astype(np.float32)


@pytest.mark.parametrize(
    ("timing", "expected_ms"),
    [
        # At the azimuths 0 (ahead), 90 (left), -90 (right), by hand.
        (SweepTiming(-1.0, np.pi, 0.1), [0.0, -25.0, 25.0]),
        (SweepTiming(1.0, np.pi, 0.1), [0.0, 25.0, -25.0]),
        (SweepTiming(1.0, np.radians(60.0), 0.1), [0.0, -75.0 - 100.0 / 12 + 100.0 / 12, -25.0]),
        (SweepTiming(-1.0, np.pi, 0.1, "start"), [50.0, 25.0, 75.0]),
        (SweepTiming(1.0, np.pi, 0.1, "end"), [-50.0, -25.0, -75.0]),
        (SweepTiming(-1.0, np.radians(1.0), 0.1), [0.1 / 0.36, 100.0 - 89.0 / 3.6, 91.0 / 3.6]),
        (SweepTiming(0.0, 0.0, 0.1), [0.0, 0.0, 0.0]),
    ],
)
def test_times_of_points_by_hand(timing: SweepTiming, expected_ms: list[float]) -> None:
    found = 1e3 * timing.offsets_s(_towards(0.0, 90.0, -90.0))
    np.testing.assert_allclose(found, expected_ms, atol=1e-3)


def test_a_timing_survives_its_dictionary_and_refuses_nonsense() -> None:
    timing = SweepTiming(-1.0, 0.3, 0.05, "end")
    again = SweepTiming.from_dict(json.loads(json.dumps(timing.to_dict())))
    assert again.stamp == "end" and again.fraction == -1.0 and again.period_s == 0.05
    assert again.start_rad == pytest.approx(0.3)
    for wrong in ({"fraction": 2.0}, {"period_s": 0.0}, {"start_deg": np.nan}, {"stamp": "middle"}):
        with pytest.raises(ConfigError):
            SweepTiming.from_dict({**timing.to_dict(), **wrong})
    assert not np.isnan(timing.offsets_s(np.full((2, 3), np.nan, np.float32))).any()


@cache
def standing() -> SimulatedDrive:
    return simulate(
        SimulationConfig(
            seed=4,
            frames=2,
            motion="standing",
            rolling=True,
            azimuth_step_deg=2.0,
            frame_rate_hz=5.0,
            sweep_start_deg=130.0,
        )
    )


@pytest.mark.parametrize("sense", ["clockwise", "counterclockwise"])
@pytest.mark.parametrize("stamp", ["forward", "start", "end"])
def test_the_simulator_fires_when_the_model_says(sense: Any, stamp: Any) -> None:
    """Two implementations of one page of geometry: the simulator's is not the estimator's."""
    config = replace(standing().config, sweep_sense=sense, sweep_stamp=stamp)
    scan = replace(standing(), config=config).scan(0)
    timing = SweepTiming(1.0 if sense == "counterclockwise" else -1.0, np.radians(130.0), 0.2, stamp)
    assert scan.offsets_s is not None
    # A point on the very border may fall to either side of it.
    apart = np.abs(scan.offsets_s - timing.offsets_s(scan.points))
    assert np.quantile(apart, 0.99) < 1e-5


def test_a_compensated_sweep_is_the_raw_one_moved_by_the_true_motion() -> None:
    raw = simulate(replace(STREET, frames=2, azimuth_step_deg=2.0))
    moved = replace(raw, config=replace(raw.config, sweep_output="compensated"))
    scan, compensated = raw.scan(1), moved.scan(1)
    assert scan.offsets_s is not None and compensated.offsets_s is None
    stamp_s = scan.stamp_ns * 1e-9
    lTw, apart = raw.wTl(stamp_s).inverse(), []
    for k in range(0, len(scan.points), 97):
        wP = raw.wTl(stamp_s + float(scan.offsets_s[k])).transformFrom(scan.points[k].astype(float))
        apart.append(lTw.transformFrom(wP) - compensated.points[k])
    assert len(apart) > 20 and np.abs(apart).max() < 1e-4
    assert np.abs(scan.points - compensated.points).max() > 0.05


# --- a hall of walls, measured by an arithmetic of its own -----------------------------------------


def _hall(
    speed: float, fraction: float, start_deg: float, yaw_rate: float = 0.0, limit_deg: float = 180.0
) -> Callable[[int], Scan]:
    """Scans of upright boards beside a straight or bending path, each point measured at its own time."""
    period_s = 0.1
    # Boards of every direction, 5 to 9 m beside the path.
    rng = np.random.default_rng(7)
    count = 40
    middle = np.column_stack(
        [rng.uniform(-12.0, 30.0, count), rng.choice([-1, 1], count) * rng.uniform(5, 9, count)]
    )
    way = rng.uniform(0.0, np.pi, count)
    along = np.linspace(-1.2, 1.2, 25)
    boards = middle[:, None] + along[None, :, None] * np.stack([np.cos(way), np.sin(way)], axis=1)[:, None]
    heights = np.linspace(-1.5, 1.5, 12)
    flat = boards.reshape(-1, 2)
    world = np.column_stack([np.repeat(flat, len(heights), axis=0), np.tile(heights, len(flat))])
    ground = np.stack(np.meshgrid(np.arange(-14.0, 34.0, 0.5), np.arange(-10.0, 10.0, 0.5)), axis=-1).reshape(
        -1, 2
    )
    world = np.vstack([world, np.column_stack([ground, np.full(len(ground), -1.7)])])

    def pose(t: float | np.ndarray[Any, Any]) -> tuple[Any, Any, Any]:
        yaw = yaw_rate * np.asarray(t)
        if yaw_rate == 0.0:
            return speed * np.asarray(t), 0.0 * yaw, yaw
        return speed / yaw_rate * np.sin(yaw), speed / yaw_rate * (1 - np.cos(yaw)), yaw

    def seen(at_s: Any) -> Any:
        x, y, yaw = pose(at_s)
        dx, dy = world[:, 0] - x, world[:, 1] - y
        return np.column_stack(
            [np.cos(yaw) * dx + np.sin(yaw) * dy, -np.sin(yaw) * dx + np.cos(yaw) * dy, world[:, 2]]
        )

    def scan(k: int) -> Scan:
        stamp_s = k * period_s
        at = np.full(len(world), stamp_s)
        for _ in range(6):  # the instant at which the beam passes depends on where the point then is
            points = seen(at)
            q = np.mod(np.arctan2(points[:, 1], points[:, 0]) - np.radians(start_deg), 2 * np.pi) / (
                2 * np.pi
            )
            forward = np.mod(-np.radians(start_deg), 2 * np.pi) / (2 * np.pi)
            at = stamp_s + fraction * period_s * (q - forward)
        noise = np.random.default_rng([3, k]).normal(0.0, 0.01, points.shape)
        kept = np.abs(np.degrees(np.arctan2(points[:, 1], points[:, 0]))) < limit_deg
        kept &= np.linalg.norm(points, axis=1) < 28.0
        points = (points + noise)[kept].astype(np.float32)
        return Scan(round(stamp_s * 1e9), points, np.full(len(points), 3, np.uint8))

    return scan


@pytest.mark.parametrize(
    ("fraction", "start_deg", "yaw_rate", "limit_deg", "kind"),
    [
        (-1.0, 180.0, 0.0, 180.0, "clockwise"),
        pytest.param(0.0, 180.0, 0.0, 180.0, "compensated", marks=pytest.mark.slow),
        pytest.param(1.0, 120.0, 0.0, 180.0, "counterclockwise", marks=pytest.mark.slow),
        pytest.param(1.0, 180.0, 0.3, 70.0, "counterclockwise", marks=pytest.mark.slow),
    ],
)
def test_the_sweep_of_a_hall(
    fraction: float, start_deg: float, yaw_rate: float, limit_deg: float, kind: str
) -> None:
    told: list[tuple[int, int]] = []
    hall = _hall(6.0, fraction, start_deg, yaw_rate, limit_deg)
    found = decide_sweep(hall, 14, progress=lambda *steps: told.append(steps))
    assert found.kind == kind, found.sentence
    assert told == sorted(told) and told[0][0] == 0 and len(told) > 6 and told[-1][0] < told[-1][1]
    assert abs(found.fraction - fraction) < 0.2
    assert found.timing.fraction == fraction and found.timing.period_s == pytest.approx(0.1)
    if limit_deg == 180.0 and fraction != 0.0:
        turned = np.degrees(found.timing.start_rad) - start_deg
        assert abs((turned + 180.0) % 360.0 - 180.0) <= 10.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("speed", "yaw_rate", "count", "fraction", "kind"),
    [
        # 22 scans of a vehicle at walking speed: 12 in a row reach 2.7 m.
        (2.5, 0.0, 22, 0.0, "compensated"),
        # In a tight turn every second scan is too far from the one before it to be registered.
        (3.0, 0.95, 24, -1.0, "clockwise"),
    ],
)
def test_the_spacing_of_scans_fits_the_drive(
    speed: float, yaw_rate: float, count: int, fraction: float, kind: str
) -> None:
    found = decide_sweep(_hall(speed, fraction, 180.0, yaw_rate), count)
    assert found.kind == kind, found.sentence


@pytest.mark.slow
def test_the_start_of_a_fast_turn_is_found() -> None:
    """2 m in a turn: points between a wrong start and the right one are off by as much, and match nothing."""
    found = decide_sweep(_hall(20.0, 1.0, -100.0), 14)
    assert found.kind == "counterclockwise", found.sentence
    turned = np.degrees(found.timing.start_rad) + 100.0
    assert abs((turned + 180.0) % 360.0 - 180.0) <= 10.0


@pytest.mark.slow
@pytest.mark.parametrize("fraction", [0.0, -1.0])
def test_an_object_that_drives_along_does_not_decide(fraction: float) -> None:
    """A truck beside the vehicle that no label tells from the static scene."""
    hall = _hall(6.0, fraction, 180.0)
    along, up = np.meshgrid(np.arange(-3.0, 5.0, 0.15), np.arange(-1.2, 2.0, 0.2))
    side = np.column_stack([along.ravel(), np.full(along.size, -3.5), up.ravel()])

    def scan(k: int) -> Scan:
        seen = hall(k)
        noise = np.random.default_rng([9, k]).normal(0.0, 0.01, side.shape)
        moving = side + noise + [0.03 * k, 0.0, 0.0]
        points = np.concatenate([seen.points, moving.astype(np.float32)])
        return Scan(seen.stamp_ns, points, np.full(len(points), 3, np.uint8))

    found = decide_sweep(scan, 14)
    assert found.kind in ("undecided", "compensated" if fraction == 0.0 else "clockwise"), found.sentence


def test_one_group_alone_excludes_no_hypothesis() -> None:
    """Groups of matches add up; the contribution of one is bounded."""
    quiet, loud = np.full((20, SECTORS), -1.0), np.zeros((20, SECTORS))
    loud[3] = -1e6
    flat = np.full((20, SECTORS), 1e-3)
    unit, curvature = np.ones(SECTORS), np.ones(SECTORS)
    both = SweepEvidence(unit, curvature, ((quiet, flat), (quiet, flat)))
    np.testing.assert_allclose(both.log_ratio(1.0), 20.0 - 20.0 * 0.5e-3)
    np.testing.assert_allclose(both.log_ratio(-1.0), -20.0 - 20.0 * 0.5e-3)
    alone = SweepEvidence(unit, curvature, ((quiet, flat), (loud, flat)))
    assert 2.9 < float(alone.log_ratio(1.0).max()) < 3.1
    against = SweepEvidence(unit, curvature, ((quiet, flat), (-quiet, flat)))
    np.testing.assert_array_equal(against.log_ratio(1.0), 0.0)


def test_groups_of_matches_add_up_to_the_registration() -> None:
    """By cell or by direction, with the poses following: the sums are the eliminated normal equations."""
    hall = _hall(6.0, -1.0, 180.0)
    window = SweepWindow([hall(k) for k in range(6)], 0.1)
    found = estimate([window])
    present = found.linearized_at[0] * CANDIDATES[found.linearized_at[1]]
    sums = window.surface_sums(CANDIDATES.T, found.normals[0], present)
    evidence = found.evidence([window])
    for by in sums:
        np.testing.assert_allclose(by.information.sum(axis=0), found.quadratic.curvature, rtol=1e-3)
        slope = found.quadratic.slope
        np.testing.assert_allclose(by.origin.sum(axis=0), -slope, atol=2e-3 * np.abs(slope).max())
    assert abs(found.fraction + 1.0) < 5.0 * evidence.sigma[found.sector] < 0.5
    # Noise of 10 mm at both ends of a match.
    assert 0.008 < np.sqrt(window.errors.own) < 0.03 and np.sqrt(window.errors.shared) < 0.01


def test_a_match_lies_along_the_mean_of_both_normals() -> None:
    """Normals of one scan that are off by an angle turn those of its matches by half of it."""
    hall, angle = _hall(0.0, 0.0, 180.0), 0.1
    window = SweepWindow([hall(k) for k in range(3)], 0.1)

    def normals() -> np.ndarray[Any, Any]:
        window.linearized(0.0, 0.0, 9)
        rows = window._matches[0]
        np.testing.assert_allclose(np.linalg.norm(rows.of_poses[:, 9:], axis=1), 1.0)
        return rows.of_poses[:, 9:]

    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    before = normals()
    other = window._surfaces[1]
    turned_normals = other.normals.copy()
    turned_normals[:, :2] = turned_normals[:, :2] @ turn.T
    window._surfaces[1] = replace(other, normals=turned_normals)
    after = normals()
    upright = np.abs(before[:, 2]) < 0.1
    assert upright.sum() > 100 and len(before) == len(after)
    first, second = (np.arctan2(n[upright, 1], n[upright, 0]) for n in (before, after))
    np.testing.assert_allclose(np.mod(second - first + np.pi, 2 * np.pi) - np.pi, 0.5 * angle, atol=1e-3)


@pytest.mark.slow
def test_nothing_is_decided_without_evidence() -> None:
    still = decide_sweep(_hall(0.0, -1.0, 180.0), 14)
    assert still.kind == "standstill" and still.timing.instant
    crawling = decide_sweep(_hall(0.5, -1.0, 180.0), 14)
    assert crawling.kind == "undecided" and crawling.timing.instant
    assert {timing.fraction for timing in crawling.others} == {-1.0, 1.0}
    hall = _hall(2.0, -1.0, 180.0, limit_deg=60.0)
    assert decide_sweep(hall, 14).kind == "undecided"
    single = decide_sweep(_hall(6.0, -1.0, 180.0), 1)
    assert single.kind == "undecided"


# --- streets ------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("output", "sense", "kind"),
    [
        ("raw", "counterclockwise", "counterclockwise"),
        ("compensated", "clockwise", "compensated"),
    ],
)
def test_the_sweep_of_a_street(output: Any, sense: Any, kind: str) -> None:
    drive = simulate(replace(STREET, sweep_output=output, sweep_sense=sense))
    found = decide_sweep(drive.scan, len(drive))
    assert found.kind == kind, found.sentence


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "output"), [(565, "raw"), (727, "compensated")])
def test_a_start_in_view_is_not_taken_for_another_one(seed: int, output: str) -> None:
    """Evidence that is bounded by group forgives a start beside the right one; and what odometry left of the
    poses' errors looks like a turn that begins ahead."""
    config = street(seed, output, 30)
    found = decided(config)
    assert found.kind == (config.sweep_sense if output == "raw" else "compensated"), found.sentence
    if output == "raw":
        away = np.degrees(found.timing.start_rad) - config.sweep_start_deg
        assert found.start_known and abs((away + 180.0) % 360.0 - 180.0) <= 10.0


@pytest.mark.slow
def test_objects_of_no_class_are_used_where_they_stand() -> None:
    """Vehicles ahead that geometry finds, not labels: at the same azimuths they move as a sweep would."""
    drive = source_of("own-544")
    assert isinstance(drive, SimulatedDrive)
    found = decide_sweep(lambda k: labelled_by_geometry(drive.scan(k)), 20)
    assert found.kind == "compensated", found.sentence


@pytest.mark.slow
def test_a_source_is_read_once_and_its_own_times_are_kept() -> None:
    class Counting:
        name, camera, nominal, truth = "hall", None, None, None

        def __init__(self) -> None:
            self.read: list[int] = []

        def __len__(self) -> int:
            return 14

        def __getitem__(self, position: int) -> Frame:
            self.read.append(position)
            return Frame(position, _hall(6.0, -1.0, 180.0)(position), None)

    source: Any = Counting()
    swept = with_sweep(source)
    frames = list(swept)
    assert sorted(source.read) == list(range(14))
    assert swept.sweep_decision.kind == "clockwise"
    expected = swept.sweep_decision.timing.offsets_s(frames[3].scan.points)  # type: ignore[union-attr]
    np.testing.assert_array_equal(frames[3].scan.offsets_s, expected)  # type: ignore[union-attr]
    assert with_sweep(swept) is swept
    # Times that the data bring are used, and nothing is decided.
    timed = simulate(replace(STREET, frames=3))
    given = with_sweep(timed)
    assert given.sweep_decision.kind == "given"
    np.testing.assert_array_equal(given[1].scan.offsets_s, timed[1].scan.offsets_s)  # type: ignore[union-attr]
    assert with_sweep(source, decide=False).sweep_decision.kind == "given"


class Hall:
    """Fourteen scans of a hall at 6 m/s as a source, of whose sweep something is said."""

    name, camera, nominal, truth = "hall", None, None, None

    def __init__(self, fraction: float, sweep: str) -> None:
        self.scan, self.sweep = _hall(6.0, fraction, 180.0), sweep

    def __len__(self) -> int:
        return 14

    def __getitem__(self, position: int) -> Frame:
        return Frame(position, self.scan(position), None)


@pytest.mark.parametrize(
    ("fraction", "said", "instead"),
    [
        (-1.0, "compensated", "clockwise"),
        (0.0, "azimuth", "compensated"),
        (-1.0, "clockwise", ""),
    ],
)
@pytest.mark.slow
def test_what_is_said_of_the_sweep_is_compared_with_the_scans(
    fraction: float, said: str, instead: str
) -> None:
    source: Any = Hall(fraction, said)
    swept = with_sweep(source)
    decision = swept.sweep_decision
    assert decision.kind == "given" and swept[3].scan.offsets_s is None  # type: ignore[union-attr]
    assert bool(decision.contradiction) == bool(instead)
    assert not instead or f"--sweep {said} says" in decision.contradiction
    assert decision.contradiction.endswith(f"say --sweep {instead}" if instead else "")
    # A result that rests on it is not trusted, and says so first.
    drive = replace(prepared_street(), sweep=decision)
    truth = standing_street().truth
    result = CalibrationResult(
        truth.cTl, 0.0, np.eye(7), "ok", drive.camera, "cam", frames_used=(FrameId(drive.name, 0),)
    )
    checked = with_causes(result, [drive], Guess(truth.cTl, 0.0), CalibrationConfig(find_causes=False))
    assert (checked.status == "not_converged") == bool(instead)
    assert any(decision.contradiction in reason for reason in checked.reasons[:1]) == bool(instead)


@pytest.mark.parametrize(
    ("fraction", "in_part"),
    [(-0.5, True), (-1.0, False), (0.0, False), (1.0, False)],
)
@pytest.mark.slow
def test_points_that_were_moved_by_half_of_the_motion_contradict_every_hypothesis(
    fraction: float, in_part: bool
) -> None:
    decision = decide_sweep(_hall(6.0, fraction, 180.0), 14)
    assert ("by the whole motion" in decision.contradiction) == in_part
    assert (decision.kind == "undecided") == in_part
    if in_part:
        assert "in them -0.5" in decision.contradiction and decision.contradiction in decision.sentence
        assert decision.given_as("compensated").contradiction == decision.contradiction


class TimedHall(Hall):
    """The same with times of the points, by the share of a turn of 0.1 s that is said to be in them."""

    def __init__(self, fraction: float, told: float) -> None:
        super().__init__(fraction, "auto")
        self.told = told

    def __getitem__(self, position: int) -> Frame:
        scan = self.scan(position)
        azimuths = np.arctan2(scan.points[:, 1], scan.points[:, 0]).astype(np.float64)
        offsets_s = self.told * 0.1 * azimuths / (2.0 * np.pi)
        return Frame(position, replace(scan, offsets_s=offsets_s.astype(np.float32)), None)


@pytest.mark.parametrize(
    ("fraction", "told", "wrong"),
    [
        (-1.0, -1.0, ""),
        (0.0, -1.0, "the times of the points say clockwise, the scans compensated ("),  # and the times kept
        (-1.0, -2.0, "the times of the points say clockwise, 0.2 s a turn, the scans clockwise ("),
        (-1.0, 1.0, "the times of the points say counterclockwise, the scans clockwise ("),
        (-1.0, 0.0, "the times of the points say compensated, the scans clockwise ("),
        (-0.5, -1.0, "the times of the points say clockwise, the scans another sweep ("),
        # Every second scan of a LiDAR that turns twice as fast.
        (-0.5, -0.5, ""),
    ],
)
@pytest.mark.slow
def test_times_of_the_points_are_compared_with_the_scans(fraction: float, told: float, wrong: str) -> None:
    source: Any = TimedHall(fraction, told)
    swept = with_sweep(source)
    decision = swept.sweep_decision
    assert decision.kind == "given" and decision.contradiction.startswith(wrong)
    assert bool(decision.contradiction) == bool(wrong)
    np.testing.assert_array_equal(swept[3].scan.offsets_s, source[3].scan.offsets_s)  # type: ignore[union-attr]


def test_times_that_do_not_follow_the_azimuth_are_of_no_turn() -> None:
    scan = TimedHall(-1.0, -1.0)[0].scan
    assert scan is not None and scan.offsets_s is not None
    assert turn_of([scan]) == pytest.approx(-0.1, rel=0.02)
    # Whatever the azimuth at which the turn begins, and where a quarter of it is out of view.
    azimuths = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    share = np.mod(azimuths - 1.0, 2.0 * np.pi) / (2.0 * np.pi)
    turned = replace(scan, offsets_s=(0.05 * share).astype(np.float32))
    assert turn_of([turned]) == pytest.approx(0.05, rel=0.02)
    seen = share < 0.75
    part = Scan(0, scan.points[seen], scan.classes[seen], offsets_s=turned.offsets_s[seen])  # type: ignore[index]
    assert turn_of([part]) == pytest.approx(0.05, rel=0.02)
    rng = np.random.default_rng(0)
    mixed = replace(scan, offsets_s=rng.permutation(scan.offsets_s))
    assert turn_of([mixed]) is None and turn_of([scan, mixed]) is None
    assert turn_of([]) is None and turn_of([replace(scan, offsets_s=None)]) is None


def test_nothing_is_compared_where_the_sweep_is_known_or_not_to_be_decided() -> None:
    for source, decide in ((Hall(-1.0, "known"), True), (Hall(-1.0, "compensated"), False)):
        decision = with_sweep(source, decide).sweep_decision  # type: ignore[arg-type]
        assert decision.kind == "given" and decision.contradiction == "" and not decision.frames


@pytest.mark.slow
def test_a_first_scan_without_points_says_nothing_of_times() -> None:
    drive = simulated(replace(STREET, frames=3))
    first = drive[0].scan
    assert first is not None
    empty = Scan(first.stamp_ns, first.points[:0], first.classes[:0])
    frames = [Frame(0, empty, None), drive[1], drive[2]]

    class Source:
        name, camera, nominal, truth = "street", drive.camera, None, None

        def __len__(self) -> int:
            return 3

        def __getitem__(self, position: int) -> Frame:
            return frames[position]

    assert with_sweep(Source()).sweep_decision.kind == "given"  # type: ignore[arg-type]


def test_the_sweep_of_a_result_is_used_again() -> None:
    decision = SweepDecision("clockwise", SweepTiming(-1.0, np.pi, 0.1), -0.97, 0.05)
    drive = simulated(replace(STREET, frames=3, sweep_output="raw"))
    again = with_sweep_of(drive, {SWEEP_KEY: {drive.name: decision.to_dict()}})
    assert isinstance(again, SweptSource) and again.sweep_decision.timing.fraction == -1.0
    assert again[0].scan is not None and again[0].scan.offsets_s is not None
    for broken in ({}, {SWEEP_KEY: 3}, {SWEEP_KEY: {drive.name: {"timing": {"fraction": "x"}}}}):
        plain = with_sweep_of(drive, broken)[0].scan
        assert plain is not None and plain.offsets_s is None


@pytest.mark.slow
def test_the_command_line_knows_both_senses(tmp_path: Path) -> None:
    write_drive(simulate(replace(STREET, frames=3, azimuth_step_deg=1.0)), tmp_path / "drive")
    stored = open_source(tmp_path / "drive")[1].scan
    model = open_source(tmp_path / "drive", sweep="clockwise")[1].scan
    assert stored is not None and model is not None and stored.offsets_s is not None
    assert model.offsets_s is not None
    np.testing.assert_allclose(model.offsets_s, stored.offsets_s, atol=2e-4)
    other = open_source(tmp_path / "drive", sweep="counterclockwise")[1].scan
    assert other is not None and other.offsets_s is not None
    np.testing.assert_allclose(other.offsets_s, -model.offsets_s, atol=1e-6)
    for option in ("compensated", "instant"):
        plain = open_source(tmp_path / "drive", sweep=option)[1].scan  # type: ignore[arg-type]
        assert plain is not None and plain.offsets_s is None
    with pytest.raises(ConfigError, match="sweep stamp"):
        open_source(tmp_path / "drive", sweep="clockwise", sweep_stamp="noon")  # type: ignore[arg-type]
    assert main(["calibrate", str(tmp_path / "drive"), "--sweep", "sideways"]) == 2


# --- real drives ----------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.drives
@pytest.mark.skipif(not PARKED.is_dir(), reason="no ../shared")
@pytest.mark.parametrize(("cloud", "kind"), [("velodyne_raw", "clockwise"), ("velodyne", "compensated")])
def test_real_clouds_as_recorded_and_compensated(tmp_path: Path, cloud: str, kind: str) -> None:
    """The same 20 scans of an HDL-64E, which turns clockwise, at 11 m/s."""
    folder, here = PARKED / "sequences" / "00", tmp_path / "sequences" / "00"
    for name in ("image_2", "semantic_2", "labels", cloud):
        made = here / ("velodyne" if name == cloud else name)
        made.mkdir(parents=True)
        for path in sorted((folder / name).iterdir())[:20]:
            (made / path.name).symlink_to(path)
    (here / "calib.txt").symlink_to(folder / "calib.txt")
    times = (folder / "times.txt").read_text().splitlines()[:20]
    (here / "times.txt").write_text("\n".join(times) + "\n")
    found = with_sweep(open_source(tmp_path)).sweep_decision
    assert found.kind == kind, found.sentence
