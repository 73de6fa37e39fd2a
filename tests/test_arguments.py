"""At most six arguments: past them, a named group is missing."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
MOST = 6


def _named(function: ast.FunctionDef | ast.AsyncFunctionDef) -> list[str]:
    """Names of the arguments, but for those that stand for the object or class itself."""
    arguments = function.args
    every = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    return [one.arg for one in every if one.arg not in ("self", "cls")]


@pytest.mark.parametrize("package", ["factors", "sst_graph"])
def test_no_function_takes_more(package: str) -> None:
    offenders, seen = [], 0
    for path in sorted((ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                seen += 1
                if len(_named(node)) > MOST:
                    offenders.append(f"{path.relative_to(ROOT)}:{node.lineno} {node.name}")
    assert seen > 100
    assert offenders == []


def test_an_argument_of_every_kind_is_counted() -> None:
    (function,) = ast.parse("def f(self, a, /, b, c=1, *rest, d, e=2, **more): ...").body
    assert isinstance(function, ast.FunctionDef)
    assert _named(function) == ["a", "b", "c", "d", "e"]
