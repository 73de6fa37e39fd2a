"""Steps and contradicting drives, found where they are and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest
from fleet.vehicle_drives import step, vehicle

from sst_graph.fleet.vehicles.changes import find_changes
from sst_graph.fleet.vehicles.walk import WalkConfig
from studies.small_changes import apart, is_found, shuffled, stepped

CONFIG = WalkConfig()


@pytest.mark.parametrize(
    ("change", "kinds", "words"),
    [
        (step(yaw_deg=1.2), ("rotation",), "yaw"),
        (step(pitch_deg=-1.0), ("rotation",), "pitch"),
        (step(forward_m=0.2), ("translation",), "forward"),
        (step(offset_s=0.06), ("offset",), "time offset by +"),
    ],
)
@pytest.mark.parametrize("at", [2, 5])
def test_a_step_is_found_between_its_drives(
    change: np.ndarray, kinds: tuple[str, ...], words: str, at: int
) -> None:
    found = find_changes(vehicle(np.random.default_rng(at), {at: change}), CONFIG)
    assert list(found.steps) == [at] and not found.contradicting
    finding = found.steps[at]
    assert finding.kinds == kinds and words in finding.words
    error = finding.difference.step - change
    assert error @ np.linalg.solve(finding.difference.covariance, error) < 24.0  # chi-squared of 7: 1 in 1000


def test_two_steps_are_both_found() -> None:
    changes = {2: step(yaw_deg=1.0), 6: step(offset_s=0.06)}
    found = find_changes(vehicle(np.random.default_rng(3), changes, count=9), CONFIG)
    assert sorted(found.steps) == [2, 6] and not found.contradicting
    assert found.steps[2].kinds == ("rotation",) and found.steps[6].kinds == ("offset",)


@pytest.mark.parametrize("k", [1, 4, 6])
def test_a_drive_that_is_wrong_is_named_and_left_out(k: int) -> None:
    drives = vehicle(np.random.default_rng(k), {}, {k: step(pitch_deg=1.7)})
    found = find_changes(drives, CONFIG)
    assert not found.steps and list(found.contradicting) == [f"drive_{k}"]
    assert [one.name for one in found.left] == [one.name for one in drives if one.name != f"drive_{k}"]


def test_a_wrong_drive_and_a_step() -> None:
    drives = vehicle(np.random.default_rng(5), {5: step(yaw_deg=1.2)}, {2: step(offset_s=0.1)}, count=9)
    found = find_changes(drives, CONFIG)
    assert list(found.contradicting) == ["drive_2"]
    assert [found.left[k].name for k in found.steps] == ["drive_5"]


def test_the_last_drive_alone_is_a_step_with_one_drive_on_a_side() -> None:
    found = find_changes(vehicle(np.random.default_rng(6), {7: step(yaw_deg=1.5)}), CONFIG)
    assert list(found.steps) == [7] and not found.contradicting


@pytest.mark.parametrize("count", [1, 2])
def test_few_drives(count: int) -> None:
    found = find_changes(vehicle(np.random.default_rng(7), {}, count=count), CONFIG)
    assert not found.steps and not found.contradicting and len(found.left) == count
    knocked = find_changes(
        vehicle(np.random.default_rng(7), {count - 1: step(yaw_deg=3.0)}, count=count), CONFIG
    )
    assert len(knocked.steps) == count - 1


def test_a_slow_walk_is_no_step() -> None:
    fast = WalkConfig(rotation_deg=0.2, translation_m=0.01, time_offset_s=0.01)
    drives = vehicle(np.random.default_rng(8), {}, count=12, config=fast)
    assert not find_changes(drives, fast).steps
    assert find_changes(drives, CONFIG).steps  # for a mount that is said to be steady, it is one


def test_false_alarms_are_as_rare_as_stated() -> None:
    """At most 5 % of vehicles without any; 60 of them: more than 8 alarms in one case of a thousand."""
    often = WalkConfig(false_alarm_rate=0.05)
    rng = np.random.default_rng(9)
    found = [find_changes(vehicle(rng, {}, count=6), often) for _ in range(60)]
    assert sum(bool(one.steps or one.contradicting) for one in found) <= 8


LENS = {"cx": step(yaw_deg=0.5), "cy": step(pitch_deg=0.4)}


def test_a_lens_that_is_off_is_no_change_and_hides_none() -> None:
    often, rng = WalkConfig(false_alarm_rate=0.05), np.random.default_rng(10)
    found = [find_changes(vehicle(rng, {}, count=6, lens=LENS), often) for _ in range(40)]
    assert sum(bool(one.steps or one.contradicting) for one in found) <= 6
    small = {4: step(yaw_deg=0.5)}
    (at,) = find_changes(vehicle(np.random.default_rng(11), small, lens=LENS), CONFIG).steps
    assert at == 4
    drives = vehicle(np.random.default_rng(11), small, lens=LENS)
    assert not find_changes(apart(drives), CONFIG).steps  # errors of that size, were they each drive's own


def test_steps_of_the_study_are_found_where_they_are() -> None:
    drives = vehicle(np.random.default_rng(12), {}, lens=LENS)
    moved = stepped(drives, 5, step(yaw_deg=1.0))
    assert is_found(find_changes(moved, CONFIG), 5, moved) and not is_found(
        find_changes(moved, CONFIG), 2, moved
    )
    (at,) = find_changes(apart(stepped(drives, 5, step(yaw_deg=3.0))), CONFIG).steps
    assert at == 5
    again = shuffled(drives, np.random.default_rng(13))
    assert [one.day for one in again] == [one.day for one in drives]
    assert {one.name for one in again} == {one.name for one in drives}
