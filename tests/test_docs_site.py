"""The documentation site builds without a warning, and its links lead somewhere."""

from __future__ import annotations

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "docs"))
import make_provenance
import make_tables

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
REFERENCE = DOCS / "reference"
PAGES = [
    path
    for path in sorted(DOCS.rglob("*.md"))
    if path not in (REFERENCE / "api.md", REFERENCE / "command-line.md") and path.parent != REFERENCE / "api"
]
"""All but those that are written from docstrings and from argparse."""


class _Links(HTMLParser):
    """Addresses and anchors of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.anchors: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if value and (tag, name) in {("a", "href"), ("img", "src"), ("script", "src"), ("link", "href")}:
                self.addresses.append(value)
            if value and name == "id":
                self.anchors.add(value)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = ["-m", "sphinx", "-W", "--keep-going", "-q", "-E", "-d", str(folder / "doctrees")]
    command += ["-D", "nb_execution_mode=off"]  # tests/test_notebooks.py runs them
    done = subprocess.run(
        [sys.executable, *command, str(DOCS), str(folder / "html")], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0 and done.stderr == "", done.stderr
    return folder / "html"


@pytest.mark.slow
def test_the_site_needs_no_network_and_its_links_lead_somewhere(site: Path) -> None:
    pages = {path: _Links() for path in site.rglob("*.html")}
    for path, links in pages.items():
        links.feed(path.read_text(encoding="utf-8"))
    assert len(pages) > 40
    dead = []
    for path, links in pages.items():
        for address in links.addresses:
            place, _, anchor = unquote(address).partition("#")
            if place.startswith(("https://", "http://", "mailto:", "data:")):
                continue
            target = (path.parent / place.partition("?")[0]).resolve() if place else path
            known = pages[target].anchors if target in pages else set()
            if not target.exists() or (anchor and target in pages and anchor not in known):
                dead.append(f"{path.relative_to(site)}: {address}")
    assert dead == []
    loaded = re.compile(r'<(?:script|img|link rel="stylesheet")[^>]*(?:src|href)="(?:https?:)?//')
    assert [path.name for path in pages if loaded.search(path.read_text(encoding="utf-8"))] == []


@pytest.mark.slow
def test_a_measured_page_of_the_site_names_the_commit_of_its_tables(site: Path) -> None:
    for name in ("measured/fit", "results/accuracy", "compared/peers"):
        page = (site / f"{name}.html").read_text(encoding="utf-8")
        assert re.search(r"last edited in commit <code[^>]*>.*?[0-9a-f]{7,}", page), name
    assert "last edited in commit" not in (site / "start" / "first.html").read_text(encoding="utf-8")


COMMAND = re.compile(r"sst-graph \w+|python -m \w+|make \w+|[\w/]+\.py\b")
"""A program that is in this repository."""
MEASURED = [*sorted((DOCS / "measured").glob("*.md")), DOCS / "compared" / "paper.md"]
MEASURED += [DOCS / "results" / name for name in ("accuracy.md", "ablation.md")]


@pytest.mark.parametrize("path", MEASURED, ids=lambda path: path.stem)
def test_a_measured_page_names_the_command_of_its_tables(path: Path) -> None:
    page = path.read_text(encoding="utf-8")
    code = " ".join(re.findall(r"```.*?```|`[^`]+`|\]\([^)]+\)", page, re.DOTALL))
    assert COMMAND.search(code), "found tables, expected the command that makes them"
    if "in a checkout of that commit" in page:
        return
    programs = re.findall(r"(?:benchmarks|studies|checks|docs/figures)[\w/]*\.py\b", code)
    assert all((ROOT / program).is_file() for program in programs)


def test_the_commit_of_tables_follows_them_alone(tmp_path: Path) -> None:
    def git(*command: str) -> str:
        author = ["-c", "user.name=a", "-c", "user.email=a@b"]
        done = subprocess.run(["git", *author, *command], cwd=tmp_path, capture_output=True, check=True)
        return done.stdout.decode().strip()

    page = tmp_path / "page.md"
    page.write_text("# Measured\n")
    assert make_provenance.origin(page) == ""
    git("init", "-q")
    page.write_text("# Measured\n\n| a |\n|---|\n| 1 |\n")
    assert make_provenance.origin(page) == ""  # not committed: no commit's figures
    git("add", "page.md")
    git("commit", "-qm", "measured")
    first = git("rev-parse", "--short", "HEAD")
    assert f"last edited in commit `{first}`" in make_provenance.origin(page)
    page.write_text(page.read_text() + "\nMore words.\n")
    git("commit", "-qam", "words")
    assert f"`{first}`" in make_provenance.origin(page)
    page.write_text(page.read_text().replace("| 1 |", "| 2 |"))
    assert f"`{first}`" in (changed := make_provenance.origin(page)) and "not committed" in changed
    git("commit", "-qam", "measured again")
    second = git("rev-parse", "--short", "HEAD")
    assert f"`{second}`" in (now := make_provenance.origin(page)) and "not committed" not in now


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_a_page_is_short_enough_to_read(path: Path) -> None:
    lines = make_tables.BLOCK.sub("", path.read_text(encoding="utf-8")).splitlines()
    prose = " ".join(line for line in lines if not line.startswith("|"))
    assert len(prose.split()) <= 1200


def _page(name: str) -> str:
    return (DOCS / name).read_text(encoding="utf-8")


def _found(pattern: str, name: str) -> tuple[str, ...]:
    """The groups of what a page has once."""
    (match,) = re.finditer(pattern, _page(name))
    return match.groups()


def test_pages_that_quote_one_run_agree() -> None:
    """The demo's street in two pages and a picture's words; a real drive's sigma in three places."""
    first, calibrate = "start/first.md", "start/calibrate.md"
    (fit,) = _found(r"\nfit +(.+)\n", first)
    assert f"\n> {fit}\n" in _page("how-to/report.md")
    verdict = _found(r"verdict +Good to (\S+)° and (\S+) cm", first)
    assert _found(r"!\[The verdict of the report: good to (\S+) degrees and (\S+) cm\]", first) == verdict
    for page in (first, calibrate):
        assert _found(r"time offset is known to (\S+) ms", page) == _found(r" ms \+- (\S+) ms ", page)
    known = _found(r" ms \+- (\S+) ms ", calibrate)
    assert _found(r"sigma of the time offset from\s+(\S+) ms to", calibrate) == known
    assert _found(r"sigma of the time offset is (\S+) ms at shift 1", "results/accuracy.md") == known


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120


@pytest.mark.slow
def test_the_program_of_the_figures_draws(tmp_path: Path) -> None:
    program = DOCS / "figures" / "make.py"
    subprocess.run([sys.executable, str(program), "clocks", "--into", str(tmp_path)], cwd=ROOT, check=True)
    drawn = (tmp_path / "clocks.svg").read_text(encoding="utf-8")
    assert "</svg>" in drawn and len(drawn) > 10_000
    refused = subprocess.run(
        [sys.executable, str(program), "clock"], cwd=ROOT, capture_output=True, text=True
    )
    assert refused.returncode == 2 and "found clock, expected some of frames, clocks" in refused.stderr


def test_figures_are_small() -> None:
    sizes = [path.stat().st_size for path in DOCS.rglob("*") if path.suffix in (".svg", ".png", ".jpg")]
    assert len(sizes) >= 8 and sum(sizes) < 1_500_000
