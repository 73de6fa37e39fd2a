"""What ``sst_graph`` offers to a program, by name."""

from __future__ import annotations

import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import sst_graph
from sst_graph.config import Settings

DOCS = Path(__file__).resolve().parent.parent / "docs"
MADE_BY_THE_PACKAGE = {"CalibrationResult", "TrackUpdate"}
"""Classes whose many fields nobody has to fill in."""


@pytest.mark.parametrize("name", sst_graph.__all__)
def test_every_public_name_has_a_docstring(name: str) -> None:
    assert getattr(sst_graph, name).__doc__
    assert name in dir(sst_graph)


def test_no_other_name_is_made_up() -> None:
    with pytest.raises(AttributeError, match="Scanner"):
        sst_graph.Scanner  # noqa: B018


def test_the_import_brings_nothing_heavy() -> None:
    heavy = "{'gtsam', 'numpy', 'cv2', 'scipy'} & set(sys.modules)"
    code = f"import sys, sst_graph; print(sorted({heavy}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_page_of_the_api_is_what_its_program_prints() -> None:
    done = subprocess.run(
        [sys.executable, str(DOCS / "make_api.py")],
        capture_output=True,
        text=True,
        check=True,
        cwd=DOCS.parent,
    )
    page = (DOCS / "api.md").read_text(encoding="utf-8")
    assert done.stdout == page
    assert [name for name in sst_graph.__all__ if f"- `{name}" not in page] == []


@pytest.mark.parametrize("name", sorted(set(sst_graph.__all__) - MADE_BY_THE_PACKAGE))
def test_constructors_take_few_arguments(name: str) -> None:
    cls = getattr(sst_graph, name)
    if not inspect.isclass(cls) or issubclass(cls, Settings | int):
        return
    needed = [one for one in inspect.signature(cls).parameters.values() if one.default is one.empty]
    assert len(needed) <= 6 and len(inspect.signature(cls).parameters) <= 7
