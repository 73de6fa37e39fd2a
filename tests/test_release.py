"""What is packed: sdist and wheel, compared with the checkout as ``make release-check`` does."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from checks.release_smoke import ROOT, compare

BUILD = """
import sys
from setuptools import build_meta
getattr(build_meta, "build_" + sys.argv[1])(sys.argv[2])
"""
VERSION = "0.1.0"


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """The sdist, the wheel made from it, and the copy of the checkout that both are made of.

    Without an index: by the setuptools that is installed.
    """
    folder = tmp_path_factory.mktemp("release")
    copy, built = folder / "checkout", folder / "built"
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if listed.returncode:
        pytest.skip("the sdist holds what git holds, and this is no checkout")
    for name in filter(None, listed.stdout.split("\0")):
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / name).exists():
            shutil.copyfile(ROOT / name, copy / name, follow_symlinks=False)
    for command in (["init", "-q"], ["add", "--all"]):
        subprocess.run(["git", *command], cwd=copy, check=True)
    built.mkdir()
    _build("sdist", copy, built)
    (sdist,) = built.glob("*.tar.gz")
    shutil.unpack_archive(sdist, folder, filter="data")
    _build("wheel", folder / sdist.name.removesuffix(".tar.gz"), built)
    (wheel,) = built.glob("*.whl")
    return sdist, wheel, copy


def _build(kind: str, source: Path, into: Path) -> None:
    environment = {**os.environ, "SETUPTOOLS_SCM_PRETEND_VERSION": VERSION}
    done = subprocess.run(
        [sys.executable, "-c", BUILD, kind, str(into)],
        cwd=source,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
def test_the_wheel_holds_the_package_of_the_checkout(packed: tuple[Path, Path, Path]) -> None:
    compare(*packed)


@pytest.mark.slow
def test_a_file_that_is_not_packed_is_named(packed: tuple[Path, Path, Path]) -> None:
    sdist, wheel, copy = packed
    forgotten = copy / "sst_graph" / "classes" / "forgotten.csv"
    forgotten.touch()
    try:
        with pytest.raises(SystemExit, match=r"differs from the checkout in .*forgotten\.csv"):
            compare(sdist, wheel, copy)
    finally:
        forgotten.unlink()
