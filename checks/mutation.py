"""How many small faults in ``factors/`` the tests of ``tests/factors`` find.

    python checks/mutation.py [--sample 600] [--seed 0] [--only hand_eye] [--out tried.jsonl]

A mutant is the source of one module with one place changed by an operator of mutmut: a number, an operator,
a comparison, a keyword, an argument, an assignment, an arm of a conditional. Each runs the tests in a forked
process, those of the module's own name first, until one fails (killed), all pass (survived) or the time is
out (killed). gtsam, NumPy and pytest are imported once, before the fork.

No mutants are made of what only messages, types and names are made of, which no test need pin down:

- string literals, and constants that are one;
- ``raise`` statements, and functions that return text or an error;
- arguments that are names for messages: of ``checked_*``, ``*_or_key``, ``custom_factor``, ``Variables.of``;
- ``strict=True`` of ``zip``, and ``assert``, which guard against faults of the package itself;
- annotations, decorators, ``__all__``, blocks under ``TYPE_CHECKING`` and ``@overload``.
"""

from __future__ import annotations

import argparse
import difflib
import importlib.abc
import importlib.machinery
import importlib.util
import json
import math
import os
import random
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import CodeType, ModuleType

import gtsam  # noqa: F401  (imported before the fork)
import libcst as cst
import libcst.matchers as m
import numpy as np  # noqa: F401
import pytest
from mutmut.mutation import mutators

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = "sst_graph.factors"
TESTS = ROOT / "tests" / "factors"
OPERATORS = [
    (kind, make) for kind, make in mutators.mutation_operators if make is not mutators.operator_string
]
MESSAGE_ARGUMENTS = {
    **{name: {0} for name in ["checked_array", "checked_covariance", "checked_positive", "checked_keys"]},
    **{name: {0, 1} for name in ["checked_key", "pose_or_key", "number_or_key"]},
    **{name: {0} for name in ["body_in_lidar", "_checked", "_twist_or_key", "_biases_and_groups", "_factor"]},
    **{"of": {0}, "Argument": {0}, "custom_factor": {5}, "Reader": {2, 3}},
}
"""Positions of the arguments of a function, by its name, that are names for messages."""
TEXT = m.Annotation(m.Name("str") | m.Name("FactorError"))


@dataclass(frozen=True, eq=False)
class Mutant:
    """One node of a module and what takes its place."""

    module: str
    path: Path
    tree: cst.Module
    node: cst.CSTNode
    mutated: cst.CSTNode

    @cached_property
    def source(self) -> str:
        return self.tree.deep_replace(self.node, self.mutated).code  # type: ignore[union-attr]

    @property
    def change(self) -> str:
        """The lines that differ, - before and + after."""
        lines = difflib.unified_diff(self.tree.code.splitlines(), self.source.splitlines(), n=0, lineterm="")
        return "\n".join(line for line in lines if not line.startswith(("---", "+++")))

    def is_one(self) -> bool:
        """Whether it compiles and differs from the module."""
        try:
            compile(self.source, str(self.path), "exec")
        except SyntaxError:
            return False
        return self.source != self.tree.code


class Places(cst.CSTVisitor):
    """Nodes that mutants are made of."""

    def __init__(self) -> None:
        self.nodes: list[cst.CSTNode] = []

    def on_visit(self, node: cst.CSTNode) -> bool:
        if _is_for_people(node):
            return False
        self.nodes.append(node)
        return True


def _is_for_people(node: cst.CSTNode) -> bool:
    return m.matches(
        node,
        m.Raise()
        | m.Assert()
        | m.Assign(value=m.SimpleString())
        | m.Arg(keyword=m.Name("strict"))
        | m.Annotation()
        | m.Decorator()
        | m.ImportFrom()
        | m.If(test=m.Name("TYPE_CHECKING"))
        | m.Assign(targets=[m.AssignTarget(m.Name("__all__"))])
        | m.FunctionDef(returns=TEXT)
        | m.FunctionDef(decorators=[m.AtLeastN(m.Decorator(m.Name("overload")), n=1)]),
    )


def _only_changes_a_message(node: cst.CSTNode, mutated: cst.CSTNode) -> bool:
    """Whether a call differs in names for messages alone, or in the ``strict`` of a ``zip``."""
    if not (isinstance(node, cst.Call) and isinstance(mutated, cst.Call)):
        return False
    name = node.func.attr.value if isinstance(node.func, cst.Attribute) else getattr(node.func, "value", "")
    if name == "zip":
        return [a.value for a in node.args if not a.keyword] == [
            a.value for a in mutated.args if not a.keyword
        ]
    if len(node.args) != len(mutated.args):
        return False
    differ = {i for i, (a, b) in enumerate(zip(node.args, mutated.args, strict=True)) if a is not b}
    return differ <= MESSAGE_ARGUMENTS.get(str(name), set())


def mutants_of(path: Path) -> Iterator[Mutant]:
    """All mutants of a module; some may not compile."""
    tree = cst.parse_module(path.read_text(encoding="utf-8"))
    places = Places()
    tree.visit(places)
    name = ".".join([PACKAGE, *path.relative_to(ROOT / "factors").with_suffix("").parts])
    for node in places.nodes:
        for kind, make in OPERATORS:
            for mutated in make(node) if isinstance(node, kind) else ():
                if not _only_changes_a_message(node, mutated):
                    yield Mutant(name, path, tree, node, mutated)


class MutatedModule(importlib.abc.MetaPathFinder, importlib.machinery.SourceFileLoader):
    """Gives a module's mutated source in place of that on disk."""

    def __init__(self, mutant: Mutant) -> None:
        super().__init__(mutant.module, str(mutant.path))
        self.mutant = mutant

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        return importlib.util.spec_from_loader(fullname, self) if fullname == self.mutant.module else None

    def get_code(self, fullname: str) -> CodeType:
        return compile(self.mutant.source, self.path, "exec")


def tests_pass(module: str) -> bool:
    """Whether the tests pass, first those in files with the module's name, then the others."""
    stem, files = module.rpartition(".")[2], sorted(TESTS.rglob("test_*.py"))
    own = [str(path) for path in files if stem and stem in path.stem]
    others = [str(path) for path in files if str(path) not in own]
    options = [
        "-x",
        "-q",
        "-o",
        "addopts=--import-mode=importlib",
        "--confcutdir",
        str(TESTS),
        "--rootdir",
        str(ROOT),
    ]
    return all(pytest.main([*options, *part]) == 0 for part in (own, others) if part)


def outcome(mutant: Mutant | None, seconds: float) -> str:
    """ "killed", "survived" or "time out" of the tests on a mutant, or on the package as it is."""
    child = os.fork()
    if child == 0:
        os.setsid()
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        if mutant:
            sys.meta_path.insert(0, MutatedModule(mutant))
        os._exit(0 if tests_pass(mutant.module if mutant else "") else 1)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return "survived" if status == 0 else "killed"
        time.sleep(0.02)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "time out"


def _tried(path: Path) -> dict[tuple[str, str], str]:
    """Outcomes in a file of an earlier run, by module and change."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    tried = [json.loads(line) for line in lines]
    return {(each["module"], each["change"]): each["outcome"] for each in tried}


def lower_bound(killed: int, count: int) -> float:
    """Wilson's lower 95 % bound of the share killed."""
    z, share = 1.645, killed / count
    middle = share + z * z / (2 * count)
    return (middle - z * math.sqrt(share * (1 - share) / count + z * z / (4 * count**2))) / (
        1 + z * z / count
    )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--sample", type=int, help="mutants to try, at random; default: all")
    parser.add_argument("--seed", type=int, default=0, help="of the sample; default: 0")
    parser.add_argument("--only", default="", help="part of a module's name")
    parser.add_argument("--seconds", type=float, default=60.0, help="limit for each mutant; default: 60")
    parser.add_argument(
        "--out", type=Path, help="JSON lines: each mutant tried; what is in there is not tried again"
    )
    chosen = parser.parse_args(arguments)
    os.chdir(ROOT)
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
    files = [path for path in sorted((ROOT / "factors").rglob("*.py")) if path.name != "__init__.py"]
    mutants = [mutant for path in files for mutant in mutants_of(path) if chosen.only in mutant.module]
    total = len(mutants)
    random.Random(chosen.seed).shuffle(mutants)
    mutants = mutants[: chosen.sample]
    print(f"{total} mutants, {len(mutants)} tried (seed {chosen.seed})", flush=True)
    if outcome(None, 10 * chosen.seconds) != "survived":
        sys.exit("the tests fail on the package as it is")
    known = {}
    if chosen.out:
        chosen.out.parent.mkdir(parents=True, exist_ok=True)
        known = _tried(chosen.out)
    found: Counter[str] = Counter()
    for mutant in mutants:
        if not mutant.is_one():
            continue
        result = known.get((mutant.module, mutant.change)) or outcome(mutant, chosen.seconds)
        found[result] += 1
        if chosen.out and (mutant.module, mutant.change) not in known:
            with chosen.out.open("a", encoding="utf-8") as out:
                print(
                    json.dumps({"module": mutant.module, "change": mutant.change, "outcome": result}),
                    file=out,
                )
        if result == "survived":
            print(f"\nsurvived in {mutant.module}\n{mutant.change}", flush=True)
    count = max(found.total(), 1)
    killed = count - found["survived"]
    print(
        f"\n{killed} of {count} killed ({100 * killed / count:.1f} %), {found['time out']} of them by time",
        end="",
    )
    print(f"; of all at least {100 * lower_bound(killed, count):.1f} % (95 %)")


if __name__ == "__main__":
    main()
