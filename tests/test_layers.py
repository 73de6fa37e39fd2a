"""The one-way direction of imports, as the contracts of pyproject.toml state it."""

from __future__ import annotations

import ast
import itertools
import re
import subprocess
import sys
from pathlib import Path

import pytest

from sst_graph.errors import count_of

ROOT = Path(__file__).resolve().parent.parent


def _imported(path: Path) -> set[str]:
    """Top-level names that a module imports, wherever in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.partition(".")[0])
    return names


def test_import_contracts_hold() -> None:
    """In a process of its own: import-linter disables the loggers of the one it runs in."""
    code = "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports(no_cache=True))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_factors_need_gtsam_and_numpy_only() -> None:
    modules = sorted((ROOT / "factors").rglob("*.py"))
    assert modules
    allowed = {"sst_graph", "gtsam", "numpy"} | set(sys.stdlib_module_names)
    strangers = {str(path.relative_to(ROOT)): _imported(path) - allowed for path in modules}
    assert {path: names for path, names in strangers.items() if names} == {}


def test_no_module_is_called_utils() -> None:
    modules = [*(ROOT / "factors").rglob("*.py"), *(ROOT / "sst_graph").rglob("*.py")]
    assert [path.name for path in modules if path.stem in ("utils", "util", "helpers", "misc")] == []


@pytest.mark.parametrize("package", ["factors", "sst_graph"])
def test_library_neither_prints_nor_exits(package: str) -> None:
    offenders = []
    for path in (ROOT / package).rglob("*.py"):
        if path.is_relative_to(ROOT / "sst_graph" / "cli"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in ("print", "exit", "sys.exit"):
                offenders.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert offenders == []


_COUNTED = re.compile(r" ([a-z]+ ){0,2}[a-z]{2,}s\b")
_NO_NOUNS = re.compile(r" ([a-z]+ )?(is|was|has|as|its|times|in|more) ")


@pytest.mark.parametrize("package", ["factors", "sst_graph"])
def test_number_and_noun_agree(package: str) -> None:
    """What is counted by len() is said by count_of: "1 pair", not "1 pairs"."""
    offenders = []
    for path in (ROOT / package).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            parts = node.values if isinstance(node, ast.JoinedStr) else []
            for number, words in itertools.pairwise(parts):
                if not (isinstance(number, ast.FormattedValue) and isinstance(words, ast.Constant)):
                    continue
                said = _COUNTED.match(str(words.value))
                if (
                    ast.unparse(number.value).startswith("len(")
                    and said
                    and not _NO_NOUNS.match(said.group())
                ):
                    offenders.append(f"{path.relative_to(ROOT)}:{number.lineno}: {said.group()}")
    assert offenders == []


def test_counts_in_words() -> None:
    assert [count_of(n, "pair") for n in (0, 1, 2)] == ["0 pairs", "1 pair", "2 pairs"]
    assert [count_of(n, "match", "matches") for n in (1, 3)] == ["1 match", "3 matches"]
