"""Each heuristic can be left out, and only while its case runs."""

from __future__ import annotations

import importlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sst_graph.batch.config import CalibrationConfig
from studies import ablation
from studies.ablation_cases import CASES, NOTHING, Case, replaced, to


def value_of(place: str) -> Any:
    """What stands at ``module:NAME`` or ``module:Class.name``."""
    module, _, names = place.partition(":")
    found: Any = importlib.import_module(f"sst_graph.{module}")
    for name in names.split("."):
        found = vars(found)[name]
    return found


def test_names_of_cases_differ() -> None:
    assert len({case.name for case in CASES}) == len(CASES) > 100


@pytest.mark.parametrize("case", CASES[1:], ids=lambda case: case.name)
def test_a_case_changes_what_it_names_and_restores_it(case: Case) -> None:
    assert case.settings or case.changes
    assert not case.settings or case.configured(CalibrationConfig()) != CalibrationConfig()
    before = {place: value_of(place) for place in case.changes}
    with case.left_out():
        assert all(value_of(place) is not original for place, original in before.items())
    assert all(value_of(place) is original for place, original in before.items())


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_lines_of_a_case_exist(case: Case) -> None:
    assert case.size >= sum(1 for _ in case.lines)
    assert set(case.methods) <= set(ablation.METHODS)


def test_a_name_is_replaced_where_it_was_imported() -> None:
    from sst_graph.batch import problem
    from sst_graph.graph import outer_loop

    with replaced("graph.outer_loop:KERNELS_PX", to((3.0,))):
        assert problem.KERNELS_PX == outer_loop.KERNELS_PX == (3.0,)
    assert problem.KERNELS_PX is outer_loop.KERNELS_PX and len(outer_loop.KERNELS_PX) == 12


@pytest.mark.parametrize(
    ("place", "error"),
    [
        ("graph.outer_loop:NO_SUCH_NAME", "nothing of this name"),
        ("covariance.jackknife:ObjectSpread.no_such", "nothing of this name"),
        ("marginal:carried", "as _carried"),
    ],
)
def test_what_cannot_be_replaced_everywhere_is_refused(place: str, error: str) -> None:
    importlib.import_module("sst_graph.export.marginal")
    with pytest.raises(LookupError, match=error), replaced(place, to(None)):
        pass


def record(case: str, error: float, sigma: float = 0.01, data: str = "first-9300") -> ablation.Record:
    """A run, its errors and sigmas the same on all axes."""
    covariance = (sigma**2 * np.eye(7)).tolist()
    return ablation.Record("joint", data, case, "", [error] * 7, covariance, "ok", seconds=2.0)


@pytest.mark.parametrize(
    ("error", "sigma", "verdict"),
    [
        (0.01, 0.01, "idle"),
        (0.0101, 0.01, "goes"),
        (0.0101, 0.0088, "stays"),  # NEES
        (0.0101, 0.02, "stays"),  # surprise
        (0.02, 0.01, "stays"),
        (0.007, 0.01, "better"),
        (0.007, 0.005, "stays"),  # NEES
        (0.01, 0.003, "stays"),  # silent
    ],
)
def test_a_verdict_is_by_errors_nees_and_silent_ones(error: float, sigma: float, verdict: str) -> None:
    (found,) = ablation.comparisons([record("lean", 0.01), record("roofs", error, sigma)], "joint")
    assert (found.case.name, found.verdict) == ("roofs", verdict)


def test_a_ratio_is_the_mean_over_rotation_translation_and_offset() -> None:
    full, other = (ablation.Run.of(record("roofs", error)) for error in (1.0, 2.0))
    assert np.exp(other.log_ratio(full)) == pytest.approx(2.0, rel=1e-4)
    # At one speed: what an offset does to the shift along the road is no error.
    late = replace(record("roofs", 0.0, data="parked"), error=[0.0, 0.0, 0.0, 0.109, 0.0, 0.0, 0.01])
    assert ablation.Run.of(late).sizes == pytest.approx([0.0, 0.0], abs=1e-12)


def test_an_unknown_case_is_refused() -> None:
    assert ablation.cases_of("roofs", "joint")[0] is NOTHING
    with pytest.raises(SystemExit, match="found cases"):
        ablation.cases_of("no_such_case", "joint")


@pytest.mark.slow
def test_two_cases_on_a_tiny_street_make_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = tmp_path / "runs.jsonl"
    words = ["--records", str(runs), "--streets", "third:1", "--frames", "6", "--cases", "roofs,clusters"]
    ablation.main(words)
    printed = capsys.readouterr().out
    assert "`roofs`" in printed and "`clusters`" in printed and "| third | 1 |" in printed
    (nothing,), (lean,), (roofs,), (clusters,) = (
        json.loads(line)["rows"] for line in runs.read_text().splitlines()[1:]
    )
    assert [one["case"] for one in (lean, roofs, clusters)] == ["lean", "roofs", "clusters"]
    assert nothing["error"] == lean["error"] == clusters["error"] != roofs["error"]
    # What the file has is not run again; a line that was cut off is.
    content = runs.read_text()
    runs.write_text(content + '{"method": "jo')
    ablation.main(words)
    assert runs.read_text() == content and capsys.readouterr().out == printed
