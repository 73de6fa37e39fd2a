"""Which version of the code runs: what stands beside figures, and beside the records they are made of."""

from __future__ import annotations

import hashlib
import subprocess
from pathlib import Path

import sst_graph

_DIRTY = "-dirty"


def code_version() -> str:
    """The commit where the code runs from a checkout, which may differ from what is installed; else the
    version of the package. It ends in ``-dirty`` where the code differs from that commit."""
    described = _git("describe", "--always", "--tags", f"--dirty={_DIRTY}").decode().strip()
    return f"commit {described}" if described else str(sst_graph.__version__)


def recorded_version() -> str:
    """:func:`code_version`, and where it is ``-dirty`` a hash of the changes to files that git follows."""
    version = code_version()
    if not version.endswith(_DIRTY):
        return version
    return f"{version} {hashlib.sha256(_git('diff', 'HEAD')).hexdigest()[:16]}"


def _git(*words: str) -> bytes:
    """What git prints of the checkout; nothing where there is none, or no git."""
    root = Path(sst_graph.__file__).parent.parent
    if not (root / ".git").exists():
        return b""
    try:
        return subprocess.run(
            ["git", "-C", str(root), *words], capture_output=True, timeout=10.0, check=True
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return b""
