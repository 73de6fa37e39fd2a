"""The commit in which the tables of a page were last edited, as its last line: git says it.

Which code made their figures stands in the page, where a command wrote it.
"""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

MEASURED = ("measured/", "results/", "compared/")
"""Pages whose tables were measured."""
TABLE = r"^\|"
"""Lines of a table."""


def origin(page: Path) -> str:
    """A line in Markdown; empty where the page has no table, or git does not know it."""
    if not re.search(TABLE, page.read_text(encoding="utf-8"), re.MULTILINE):
        return ""
    last = _git(page, "log", "-1", "--follow", "--format=%h %cs", f"-G{TABLE}", "--", page.name)
    if not last:
        return ""
    commit, date = last.split()
    line = f"The tables of this page were last edited in commit `{commit}` ({date})."
    if _git(page, "diff", "HEAD", "--name-only", f"-G{TABLE}", "--", page.name):
        line += " **Some have changed since and are not committed.**"
    return f"\n\n---\n\n*{line}*\n"


def _git(page: Path, *command: str) -> str:
    """What git prints; empty where there is no git or no repository."""
    try:
        done = subprocess.run(
            ["git", *command], cwd=page.parent, capture_output=True, text=True, timeout=60, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()
