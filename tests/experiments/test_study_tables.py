"""What studies and checks print for the pages: heads and cells by hand."""

from __future__ import annotations

import numpy as np

from checks import fault_matrix, fuzz
from sst_graph.experiments import assumptions
from studies import (
    broken_lens,
    contradictions,
    fused_drives,
    principal_point,
    shaking_pictures,
    small_streets,
    sweep,
)


def test_steps_that_are_found() -> None:
    knocks = contradictions.knocks_table({101: [False] * 5 + [True] * 2, 102: [True] * 7})
    assert knocks.splitlines()[0] == "| knock | 0.1° | 0.2° | 0.3° | 0.5° | 1° | 2° | 3° |"
    assert knocks.splitlines()[2].startswith("| found | 1 of 2 | ") and knocks.endswith("| 2 of 2 |\n")
    clocks = contradictions.clocks_table({102: [False, True, True, True, True]})
    assert clocks.splitlines()[2] == f"| seed 102 ({contradictions.street(102).motion}) | no{4 * ' | yes'} |"


def test_decisions_about_sweeps() -> None:
    none = [0, 0, 0]
    found = sweep.decisions_table(
        {
            ("±50°", "below 0.15 m"): {"raw": [0, 1, 0], "compensated": none},
            ("±50°", "0.3 m or more"): {"raw": [9, 0, 0], "compensated": none},
            ("full", "0.3 m or more"): {"raw": [11, 0, 1], "compensated": none},
        }
    )
    assert found.splitlines() == [
        "| view | driven in a turn | raw | compensated |",
        "|---|---|---|---|",
        "| full | 0.3 m or more | 11, 0, 1 | 0, 0, 0 |",
        "| ±50° | 0.3 m or more | 9, 0, 0 | 0, 0, 0 |",
        "| ±50° | below 0.15 m | 0, 1, 0 | 0, 0, 0 |",
    ]


def test_fused_drives() -> None:
    found = fused_drives.table_of([1.0, 2.0, 6.0], {"fused": [(1.0, False), (2.0, True)]})
    assert found.splitlines()[2:] == [
        "| drives by themselves | 3.00, 2.00, 6.0 | – |",
        "| fused | 1.50, 1.50, 2.0 | 1 |",
    ]


def test_small_streets() -> None:
    rows = [
        small_streets.Row(1, "first", "clean", "ok", "k1", 3.5, 0.5),
        small_streets.Row(2, "first", "clean", "not_converged", "", 9.0, 7.0),
    ]
    line = " | 2 | 1 | 1, 0, 1 | 1 | 0.50, 0.50 |"
    assert small_streets.table(rows).splitlines()[2:] == [f"| clean | all{line}", f"| clean | first{line}"]


def test_shaken_pictures() -> None:
    one = shaking_pictures.Outcome(
        "ok", np.array([0.5, 1.0, 2.0]), np.array([7.0, 5.0]), np.array([3.0, 2.0])
    )
    assert shaking_pictures._cells([one], [one]) == ["1 of 1", "0.50, 1.00, 2.0", "7.0, 5.0", "3.0, 2.0 σ"]


def test_a_lens_broken_by_a_size() -> None:
    assert broken_lens.size_of(np.array([np.radians(0.3), 0, np.radians(0.4), 0, 0.05, 0, -0.002])) == (
        "0.500°, 5.00 cm, 2.0 ms"
    )


def test_broken_assumptions_by_their_sizes_in_sigmas() -> None:
    def one(case: str, size: float, against: tuple[str, ...]) -> assumptions.AssumptionRun:
        error = np.array([0.002, *np.zeros(6)])
        estimates = {"k1": (0.0, 0.01)}
        return assumptions.AssumptionRun(5, case, size, "ok", error, 1e-6 * np.eye(7), estimates, against)

    runs = [one("clean", 0.0, ()), one("k1", 0.02, ()), one("k1", -0.02, ()), one("k1", 0.05, ("k1",))]
    found = assumptions.table(runs, in_sigmas=True).splitlines()
    assert found[0] == "| broken | σ | ± 2 σ | ± 5 σ |"
    assert found[2] == "| `k1` | 0.01 | 0, 0, 0, 0 of 2; 0.57, 0.57 | 1, 1, 0, 0 of 1; 0.57, 0.57 |"


def test_a_principal_point_that_is_off() -> None:
    found = {("5, 0 px", "0.1"): [("ok", 4.1), ("not_converged", 9.0), ("ok", 2.0)], ("0, 0 px", "0.1"): []}
    assert principal_point.summary(found).splitlines()[2:] == [
        "| 5, 0 px | 0.1 | 2 of 3 | 2.0 to 4.1 |",
        "| 0, 0 px | 0.1 | 0 of 0 | – |",
    ]


def test_faults_by_command() -> None:
    rows = [fault_matrix.Row("export", "disk full"), fault_matrix.Row("track", "SIGINT")]
    rows[0].runs, rows[1].runs = 5, 20
    rows[1].failures.append("left something")
    assert fault_matrix.table(rows).splitlines() == [
        "| fault | `export` | `track` |",
        "|---|---|---|",
        "| disk full | 0 of 5 | – |",
        "| SIGINT | – | 1 of 20 |",
    ]


def test_fuzzed_inputs_by_kind() -> None:
    cases = [
        fuzz.Case(0, "scan", "error", "cut off", 0.1),
        fuzz.Case(1, "scan", "value", "", 0.2),
        fuzz.Case(2, "image", "FAILURE", "died", 0.3),
    ]
    assert fuzz.table_of(cases).splitlines()[2:] == [
        "| image | 1 |  | 1 | 0.30 |",
        "| scan | 2 | 1 error, 1 value | 0 | 0.20 |",
        "| all | 3 | 1 error, 1 value | 1 | 0.30 |",
    ]
