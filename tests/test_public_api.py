"""What ``sst_graph`` offers to a program, by name."""

from __future__ import annotations

import subprocess
import sys

import pytest

import sst_graph


@pytest.mark.parametrize("name", sst_graph.__all__)
def test_every_public_name_says_what_it_is(name: str) -> None:
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
