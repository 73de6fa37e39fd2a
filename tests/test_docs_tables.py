"""Tables of the documentation name the command and the code that made them."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from sst_graph.cli.options.parser import build_parser

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "docs"))
import make_tables

DOCS = Path(__file__).resolve().parent.parent / "docs"
TABLES = [table for page in sorted(DOCS.rglob("*.md")) for table in make_tables.tables_of(page)]


def test_pages_have_such_tables() -> None:
    assert len(TABLES) >= 15 and len({(table.page, table.command) for table in TABLES}) == len(TABLES)


@pytest.mark.parametrize("table", TABLES, ids=lambda table: f"{table.page.stem}-{table.command[:60]}")
def test_a_table_stands_below_its_command(table: make_tables.Table) -> None:
    text = table.page.read_text(encoding="utf-8")
    (block,) = (one for one in make_tables.BLOCK.finditer(text) if one["command"] == table.command)
    assert block["body"].startswith(f"```\n{table.command}\n```\n\n") and "|---|" in block["body"]
    assert re.fullmatch(r"([0-9a-f]{7,12})?", table.commit)  # none: of unknown code
    words = shlex.split(table.command)
    if words[0] == "sst-graph":
        build_parser().parse_args(words[1:])


def test_what_a_command_prints_replaces_the_table(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    command = """python -c "print('| a |'); print('|---|'); print('| STOP |')" """.strip()
    page.write_text(f"# Page\n\n<!-- table: {command} -->\n<!-- end of table -->\n\nText.\n")
    (empty,) = make_tables.tables_of(page)
    assert (empty.command, empty.commit) == (command, "")
    printed = make_tables.printed_by(command, {"STOP": str(tmp_path)})
    assert printed == "| a |\n|---|\n| STOP |\n"
    beside = 200 * "x" + "\nMade by `x`, sst-graph commit 1.\n"
    body = make_tables.body(command, f"{printed}\n\n\n{beside}", "abcdef12")
    page.write_text(make_tables.replaced(page.read_text(), command, body))
    (made,) = make_tables.tables_of(page)
    assert made.commit == "abcdef12" and made.has(["page", "print"]) and not made.has(["other"])
    assert page.read_text() == (
        f"# Page\n\n<!-- table: {command} -->\n```\n{command}\n```\n\n| a |\n|---|\n| STOP |\n\n"
        "*Made by sst-graph commit abcdef12.*\n<!-- end of table -->\n\nText.\n"
    )


@pytest.mark.parametrize(
    ("command", "why"),
    [
        ("python -c 'print(1)'", "no table"),
        ("python -c 'raise SystemExit(3)'", "exit code 3"),
        ("make all", "expected sst-graph or python"),
        ("sst-graph experiment drives --data STOP PARKED", "needs --data PARKED=DIR"),
    ],
)
def test_a_command_without_a_table_is_said(command: str, why: str) -> None:
    with pytest.raises(make_tables.TableError, match=why):
        make_tables.body(command, make_tables.printed_by(command, {"STOP": "."}), "abcdef12")


@pytest.mark.parametrize(
    ("now", "same"),
    [
        ('"""Other words."""\n\n\ndef half(x):\n    """Half of it."""  # shorter\n    return x / 2\n', True),
        ('"""A module."""\n\n\ndef half(x):\n    return x / 3\n', False),
        (None, False),
    ],
)
def test_words_do_not_make_other_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, now: str | None, same: bool
) -> None:
    """Docstrings, comments and added files leave figures valid; another number or a lost file does not."""

    def git(*command: str) -> str:
        who = ["-c", "user.name=a", "-c", "user.email=a@b"]
        whole = ["git", *who, *command]
        return subprocess.run(whole, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.strip()

    source = tmp_path / "sst_graph" / "half.py"
    source.parent.mkdir()
    source.write_text('"""A module."""\n\n\ndef half(x):\n    return x / 2\n')
    git("init", "-q")
    git("add", ".")
    git("commit", "-q", "-m", "Half")
    commit = git("rev-parse", "--short", "HEAD")
    (tmp_path / "sst_graph" / "added.py").write_text("x = 1\n")
    if now is None:
        source.unlink()
    else:
        source.write_text(now)
    git("add", ".")
    monkeypatch.setattr(make_tables, "ROOT", tmp_path)
    assert make_tables.same_code(commit, "sst-graph experiment fit") is same
    assert not make_tables.same_code("0000000", "sst-graph experiment fit")
