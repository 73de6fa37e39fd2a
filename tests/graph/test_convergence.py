"""How steps of the outer loop are shortened."""

from __future__ import annotations

from sst_graph.graph.outer_loop import FULL_STEPS, step_share


def test_whole_steps_then_ever_smaller_ones() -> None:
    assert [step_share(n) for n in range(-5, FULL_STEPS + 1)] == [1.0] * (FULL_STEPS + 6)
    assert [step_share(FULL_STEPS + n) for n in (1, 2, 3)] == [1 / 2, 1 / 3, 1 / 4]


def test_a_circle_ends_in_its_middle() -> None:
    """Steps that lead from one side to the other for ever: whole ones never end, these do, half way."""
    at, steps = 0.0, []
    for n in range(40):
        target = 1.0 if at < 0.5 else 0.0
        steps.append(step_share(n) * (target - at))
        at += steps[-1]
    assert abs(at - 0.5) < 0.1 and abs(steps[-1]) < 0.1
