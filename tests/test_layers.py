"""The one-way direction of imports, as the contracts of pyproject.toml state it."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

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
