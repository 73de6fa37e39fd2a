"""Makes the tables of the pages again.

``python docs/make_tables.py [WORD ...] [--data STOP=DIR] [--data PARKED=DIR]``

A table stands between two comments, of which the first holds the command that makes it::

    <!-- table: sst-graph experiment fit --set 'seeds=[21,22]' -->
    <!-- end of table -->

What the command prints goes between them, with the command above it and the version of the code below it. A
table without a version is of unknown code, and counts as one that this code has not made.
Words choose tables whose page or command has all of them. Tables that this code, or code that does not differ
from it but for comments and docstrings, has made are left as they are; so what was interrupted goes on.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
CODE = {"sst-graph": ("sst_graph", "factors"), "python": ("sst_graph", "factors", "studies")}
"""Folders that the figures of a command depend on, by its first word."""
_APART = re.compile(r"\b(benchmarks|checks)[./]")
"""In commands: the folder of a program that is no study."""
DRIVES = ("STOP", "PARKED")
"""Names in commands that stand for the folders of drives."""
BLOCK = re.compile(r"<!-- table: (?P<command>.+?) -->\n(?P<body>.*?)<!-- end of table -->", re.DOTALL)
_STAMP = re.compile(r"^\*Made by sst-graph commit (?P<commit>[0-9a-f]+)\.\*$", re.MULTILINE)
_ORIGIN = re.compile(r"^Made by `.*`, sst-graph .*$", re.MULTILINE)
_LONGEST = 100
"""Letters of a line that is kept beside tables: names, and no paragraph, which the page has once."""
_ASSIGNMENT = re.compile(r"(?P<name>[A-Z_]+)=(?P<value>\S*)$")


class TableError(Exception):
    """A command that makes no table."""


@dataclass(frozen=True)
class Table:
    """A table of a page.

    Attributes:
        page: where it stands.
        command: that makes it, in one line.
        commit: of the code that made it; empty where none is said.
    """

    page: Path
    command: str
    commit: str

    def has(self, words: list[str]) -> bool:
        """Whether its page or its command holds all words."""
        return all(word in f"{self.page.stem} {self.command}" for word in words)


def tables_of(page: Path) -> Iterator[Table]:
    """The tables of a page between such comments."""
    for block in BLOCK.finditer(page.read_text(encoding="utf-8")):
        stamp = _STAMP.search(block["body"])
        yield Table(page, block["command"], stamp["commit"] if stamp else "")


def body(command: str, printed: str, commit: str) -> str:
    """What stands between the comments.

    Raises:
        TableError: what was printed has no table.
    """
    lines = _ORIGIN.sub("", printed).splitlines()
    text = "\n".join(line for line in lines if line.startswith("|") or len(line) <= _LONGEST).strip()
    text = re.sub(r"\n{3,}", "\n\n", text)
    if not re.search(r"^\|.*\|$", text, re.MULTILINE):
        raise TableError(f"no table in what it printed: {text[-200:]!r}")
    return f"```\n{command}\n```\n\n{text}\n\n*Made by sst-graph commit {commit}.*\n"


def replaced(text: str, command: str, new: str) -> str:
    """A page with a new body for the table of a command."""

    def one(block: re.Match[str]) -> str:
        if block["command"] != command:
            return block[0]
        return f"<!-- table: {command} -->\n{new}<!-- end of table -->"

    return BLOCK.sub(one, text)


def printed_by(command: str, data: Mapping[str, str]) -> str:
    """What a command prints, with the folders of drives in place of their names, and names again after it.

    Raises:
        TableError: a drive that is not given, or a command that fails.
    """
    lacking = [name for name in DRIVES if re.search(rf"\b{name}\b", command) and name not in data]
    if lacking:
        raise TableError(f"needs {' '.join(f'--data {name}=DIR' for name in lacking)}")
    filled = command
    for name, folder in data.items():
        filled = re.sub(rf"\b{name}\b", lambda _, folder=folder: folder, filled)
    words, environment = shlex.split(filled), dict(os.environ)
    while words and (assigned := _ASSIGNMENT.match(words[0])):
        environment[assigned["name"]] = assigned["value"]
        words.pop(0)
    programs = {"sst-graph": [sys.executable, "-m", "sst_graph"], "python": [sys.executable]}
    if words[0] not in programs:
        raise TableError(f"found {words[0]}, expected {' or '.join(programs)}")
    done = subprocess.run(
        [*programs[words[0]], *words[1:]],
        cwd=ROOT,
        env=environment | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise TableError(f"exit code {done.returncode}: {done.stderr.strip()[-300:]}")
    text = done.stdout
    for name, folder in data.items():
        text = text.replace(folder, name)
    return text


def same_code(commit: str, command: str) -> bool:
    """Whether the code of a commit makes the figures of a command that this code makes.

    Files that were added since, comments and docstrings make no difference.
    """
    if not commit:
        return False
    folders = (*CODE["python" if "python" in command.split() else "sst-graph"], *_APART.findall(command))
    changed = _git("diff", "--name-only", "--no-renames", "--diff-filter=a", commit, "--", *folders)
    return changed is not None and all(_same_file(commit, name) for name in changed.splitlines())


def _same_file(commit: str, name: str) -> bool:
    before, now = _git("show", f"{commit}:{name}"), ROOT / name
    if before is None or not now.is_file() or now.suffix != ".py":
        return False
    return _executed(before) == _executed(now.read_text(encoding="utf-8"))


def _executed(source: str) -> str:
    """The syntax tree of a program without its docstrings."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        for block in ("body", "orelse", "finalbody"):
            statements = getattr(node, block, None)
            if isinstance(statements, list):
                setattr(node, block, [one for one in statements if not _is_text(one)])
    return ast.dump(tree)


def _is_text(statement: ast.stmt) -> bool:
    value = getattr(statement, "value", None) if isinstance(statement, ast.Expr) else None
    return isinstance(value, ast.Constant) and isinstance(value.value, str)


def _git(*command: str) -> str | None:
    """What git prints; None where it fails, as for a commit that it does not know."""
    done = subprocess.run(["git", *command], cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout if done.returncode == 0 else None


def _commit() -> str:
    found = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return found.stdout.strip()


def _drive(text: str) -> tuple[str, str]:
    name, _, folder = text.partition("=")
    if name not in DRIVES or not Path(folder).is_dir():
        raise argparse.ArgumentTypeError(f"found {text!r}, expected {' or '.join(DRIVES)}=an existing folder")
    return name, str(Path(folder).resolve())


def main() -> int:
    """Makes the tables that are chosen; 1 where one of them failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("words", nargs="*", metavar="WORD", help="of page or command (default: all tables)")
    parser.add_argument(
        "--data",
        action="append",
        default=[],
        type=_drive,
        metavar="NAME=DIR",
        help=f"a drive that commands name: {', '.join(DRIVES)} (repeatable)",
    )
    parser.add_argument("--list", action="store_true", help="only print them, and which code made them")
    args = parser.parse_args()
    data = dict(args.data)
    found = [table for page in sorted(HERE.rglob("*.md")) for table in tables_of(page)]
    chosen = [table for table in found if table.has(args.words)]
    if args.list:
        for table in chosen:
            state = "as now" if same_code(table.commit, table.command) else "other code"
            print(f"{table.page.relative_to(HERE)}: {table.commit or 'never'} ({state}): {table.command}")
        return 0
    if not all(same_code("HEAD", table.command) for table in chosen):
        parser.error("changes of the code that are not committed: no version would name them")
    failed, commit = 0, _commit()
    for table in chosen:
        if same_code(table.commit, table.command):
            continue
        began = time.monotonic()
        try:
            new = body(table.command, printed_by(table.command, data), commit)
        except TableError as error:
            failed += 1
            print(f"{table.page.name}: {table.command}: {error}", file=sys.stderr, flush=True)
            continue
        table.page.write_text(
            replaced(table.page.read_text(encoding="utf-8"), table.command, new), encoding="utf-8"
        )
        print(f"{table.page.name}: {time.monotonic() - began:.0f} s: {table.command}", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
