"""Loaders that installed packages add, seen by their metadata."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sst_graph.cli import main
from sst_graph.data import loader_names, open_source
from sst_graph.data.source import loader_behind
from sst_graph.errors import ConfigError, DataError

PACKAGE = Path(__file__).parents[3] / "examples" / "loader_package"
K = np.array([[300.0, 0.0, 40.0], [0.0, 310.0, 30.0], [0.0, 0.0, 1.0]])


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, *lines: str) -> None:
    """Metadata of an installed distribution whose entry points are ``lines``."""
    info = folder / "sst_graph_npz-0.1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: sst-graph-npz\nVersion: 0.1.0\n")
    (info / "entry_points.txt").write_text("\n".join(["[sst_graph.loaders]", *lines]) + "\n")
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.syspath_prepend(str(PACKAGE))


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    folder = tmp_path / "street"
    folder.mkdir()
    for k in range(3):
        points = np.random.default_rng(k).uniform(1.0, 20.0, (50, 3)).astype(np.float32)
        pixels = np.full((60, 80, 3), 10 * k, np.uint8)
        np.savez(folder / f"{k:06d}.npz", stamp_ns=k * 100_000_000, points=points, pixels=pixels, K=K)
    return folder


def test_the_example_package(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(DataError, match="no layout that is known"):
        open_source(drive)
    install(tmp_path / "site", monkeypatch, "npz = sst_graph_npz:LOADER")
    assert "npz = " in (PACKAGE / "pyproject.toml").read_text()
    assert loader_names()[-1] == "npz"
    for loader in ("auto", "npz"):
        source = open_source(drive, loader=loader, frames="1:3")
        assert [frame.index for frame in source] == [1, 2]
    assert main(["info", str(drive), "--loader", "npz"]) == 0
    out = capsys.readouterr().out
    assert "street: 3 frames" in out and "80x60 px, fx 300.00" in out
    assert main(["info", str(drive), "--loader", "none"]) == 2
    assert "expected one of auto, kitti, kitti-raw, folder, nuscenes, ros, npz" in capsys.readouterr().err


def test_an_entry_point_that_fails_says_which(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path / "site", monkeypatch, "gone = absent_module:LOADER", "odd = sst_graph_npz:open_npz")
    with pytest.raises(ConfigError, match="'gone' of absent_module:LOADER: ModuleNotFoundError"):
        open_source(drive, loader="gone")
    with pytest.raises(
        ConfigError, match="'odd' of sst_graph_npz:open_npz: found a function, expected a Loader"
    ):
        open_source(drive, loader="odd")


def test_a_picture_of_another_size_is_named(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    install(tmp_path / "site", monkeypatch, "npz = sst_graph_npz:LOADER")
    odd = dict(np.load(drive / "000002.npz")) | {"pixels": np.zeros((30, 40, 3), np.uint8)}
    np.savez(drive / "000002.npz", **odd)
    assert main(["calibrate", str(drive), "--init", "none", "--out", str(tmp_path / "out")]) == 2
    said = (
        "frame 2: found a picture of 40x30 px, expected 80x60 px, the camera's size: all of a drive have it"
    )
    assert said in capsys.readouterr().err


def test_an_exception_in_a_loader_is_told_from_others(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path / "site", monkeypatch, "npz = sst_graph_npz:LOADER")
    source = open_source(drive)
    np.savez(drive / "000001.npz", stamp_ns=100_000_000)
    with pytest.raises(KeyError) as caught:
        source[1]
    behind = loader_behind(caught.value)
    assert behind is not None and behind[0] == "npz" and behind[1].startswith("sst_graph_npz.py:")
    with pytest.raises(KeyError) as caught:
        {}["not in a loader"]
    assert loader_behind(caught.value) is None


def test_the_names_of_our_own_are_not_replaced(
    kitti_drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path / "site", monkeypatch, "kitti = absent_module:LOADER", "auto = absent_module:LOADER")
    assert len(open_source(kitti_drive, loader="kitti")) == len(open_source(kitti_drive)) == 5
