"""What ``sst_graph`` offers to a program, by name."""

from __future__ import annotations

import inspect
import subprocess
import sys
from enum import Enum
from pathlib import Path
from types import ModuleType

import pytest

import sst_graph
import sst_graph.export
import sst_graph.factors
from sst_graph.config import Settings
from sst_graph.factors import PinholeCamera
from sst_graph.tracker import Tracker

DOCS = Path(__file__).resolve().parent.parent / "docs"
MADE_BY_THE_PACKAGE = {"CalibrationResult", "PointwiseMoved", "TrackUpdate"}
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
    page = (DOCS / "reference" / "api.md").read_text(encoding="utf-8")
    assert done.stdout == page
    assert [name for name in sst_graph.__all__ if f"- `{name}" not in page] == []


def test_the_tracker_has_few_methods_and_parts() -> None:
    assert len([name for name in vars(Tracker) if not name.startswith("_")]) <= 8
    assert len(vars(Tracker(PinholeCamera(300.0, 300.0, 160.0, 60.0, 320, 120)))) <= 8


@pytest.mark.parametrize("package", [sst_graph, sst_graph.export, sst_graph.factors])
def test_constructors_need_few_arguments(package: ModuleType) -> None:
    for name in sorted(set(package.__all__) - MADE_BY_THE_PACKAGE):
        cls = getattr(package, name)
        if inspect.isclass(cls) and not issubclass(cls, Settings | Enum):
            parameters = inspect.signature(cls).parameters.values()
            needed = [one.name for one in parameters if one.default is one.empty]
            assert len(needed) <= 6, f"{name}: {needed}"
            assert package is not sst_graph or len(parameters) <= (7 if name == "Scan" else 6), name
