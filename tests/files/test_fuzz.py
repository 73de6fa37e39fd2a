"""A thousand mutated inputs of every kind end in a value or in one printable line."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from checks import fuzz, fuzz_mutations

SEED, COUNT = 20, 1000
IMPORTED = "from sst_graph.errors import SstGraphError"


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    fuzz.prepare(folder)
    return folder


@pytest.mark.slow
def test_no_mutated_input_brings_anything_down(inputs: Path) -> None:
    kinds = [kind for kind, (_, weight) in fuzz.KINDS.items() if weight]
    cases = list(fuzz.cases(inputs, fuzz.Trials(SEED), fuzz.plan(SEED, COUNT, kinds)))
    assert [case for case in cases if case.verdict == "FAILURE"] == []
    assert len(cases) == COUNT and {case.kind for case in cases} == set(kinds)
    ends = Counter(case.verdict for case in cases)
    # Mutations are neither all harmless nor all gross.
    assert ends["value"] > 0.05 * COUNT and ends["error"] > 0.3 * COUNT
    assert ends["exit 0"] > 10 and ends["exit 2"] > 10


def _case_of(inputs: Path, bad: str) -> fuzz.Case:
    """The verdict on a piece of code, which reads none of the inputs."""

    def attempt(ground: fuzz.Ground, rng: np.random.Generator) -> None:
        exec(bad, {"np": np})

    trials = fuzz.Trials(1, {"bad": (attempt, 1.0)}, max_seconds=0.5)
    (case,) = fuzz.cases(inputs, trials, [(0, "bad")])
    return case


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        ("raise KeyError('a')", "KeyError"),
        ("while True: pass", "more than 0.5 s"),
        ("import time; time.sleep(60)", "more than 0.5 s"),
        ("np.ones(1 << 28)", "MemoryError"),
        ("import os; os.kill(os.getpid(), 9)", "the process died"),
        ("import os; os.write(2, b'libpng error')", "lines of a library"),
        (f"{IMPORTED}\ne = SstGraphError()\ne.args = ('a\\x1b',)\nraise e", "no printable line"),
    ],
)
@pytest.mark.slow
def test_the_fuzzer_sees_what_is_wrong(tmp_path: Path, bad: str, why: str) -> None:
    case = _case_of(tmp_path, bad)
    assert case.verdict == "FAILURE" and why in case.why, case


def test_an_error_of_the_package_is_no_failure(tmp_path: Path) -> None:
    case = _case_of(tmp_path, f"{IMPORTED}\nraise SstGraphError('a')")
    assert (case.verdict, case.why) == ("error", "a")


def test_a_case_is_made_again_from_its_number() -> None:
    data = bytes(range(256)) * 4
    twice = [fuzz_mutations.bytewise(np.random.default_rng([3, 7]), data) for _ in range(2)]
    assert twice[0] == twice[1]
    assert fuzz.plan(5, 50, ["calib", "times"]) == fuzz.plan(5, 50, ["calib", "times"])
