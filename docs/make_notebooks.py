"""Makes the notebooks' pages: each percent script of ``notebooks/`` as a Jupyter notebook without outputs.

The build of the site runs them and shows what they print and draw.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import jupytext

ROOT = Path(__file__).resolve().parent.parent


def sources_digest() -> str:
    """Digest of the package's modules: outputs that another state of them made are not shown."""
    digest = hashlib.sha256()
    for folder in (ROOT / "sst_graph", ROOT / "factors"):  # rglob does not follow the link sst_graph/factors
        for path in sorted(folder.rglob("*.py")):
            digest.update(path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def write_pages(folder: Path, digest: str) -> None:
    """Write a page for each notebook, if it says anything new; remove those of notebooks that are gone."""
    folder.mkdir(parents=True, exist_ok=True)
    scripts = sorted((ROOT / "notebooks").glob("*.py"))
    for page in folder.glob("*.ipynb"):
        if page.stem not in {script.stem for script in scripts}:
            page.unlink()
    for script in scripts:
        notebook = jupytext.read(script, fmt="py:percent")
        notebook.metadata["sst_graph_sources"] = digest  # a page is read again when the package has changed
        for number, cell in enumerate(notebook.cells):
            cell["id"] = f"cell-{number}"  # jupytext draws them at random
        text = jupytext.writes(notebook, fmt="ipynb")
        page = folder / f"{script.stem}.ipynb"
        if not page.is_file() or page.read_text(encoding="utf-8") != text:
            page.write_text(text, encoding="utf-8")
