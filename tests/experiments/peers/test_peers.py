"""Each peer against a closed form, or on a scene made for it; then the table and the command."""

from __future__ import annotations

import dataclasses
import functools
import shutil
from pathlib import Path

import gtsam
import numpy as np
import pytest
from stored import simulated

from sst_graph.batch import CalibrationConfig, prepare_drives
from sst_graph.cli import main
from sst_graph.drive.preparation import Drive
from sst_graph.errors import ConfigError, EstimationError
from sst_graph.experiments.peers import statistics
from sst_graph.experiments.peers.depth_edges import edge_map, solve_depth_edges
from sst_graph.experiments.peers.frames import PeerFrame, PeerProblem, peer_frames
from sst_graph.experiments.peers.hand_eye import park_martin
from sst_graph.experiments.peers.least_squares import solve_least_squares
from sst_graph.experiments.peers.mask_consistency import solve_mask_consistency
from sst_graph.experiments.peers.methods import NAMES, OWN, PEERS
from sst_graph.experiments.peers.runs import PeerRun, PeersConfig
from sst_graph.experiments.peers.table import markdown
from sst_graph.metrics import quaternion_angle_deg
from sst_graph.simulator import SimulationConfig

STREET = SimulationConfig(
    seed=5,
    frames=3,
    motion="standing",
    width=621,
    height=187,
    azimuth_limit_deg=60.0,
    time_offset_s=0.0,
    label_noise=0.0,
    moving_fraction=0.0,
)


@functools.cache
def street() -> tuple[gtsam.Pose3, Drive, list[PeerFrame]]:
    """Truth, drive and frames; the intensities are the grey levels that the points see."""
    source = simulated(STREET)
    drive = prepare_drives([source], CalibrationConfig(method="joint"))[0]
    frames = []
    for frame in peer_frames(source, drive, 0.0, 2):
        inside, uvs = frame.pixels(source.truth.cTl, frame.lPs)
        values = np.zeros(len(frame.lPs))
        rows, columns = np.round(uvs[:, 1]).astype(int), np.round(uvs[:, 0]).astype(int)
        values[inside] = frame.grey[rows.clip(0, 186), columns.clip(0, 620)] / 255.0
        frames.append(dataclasses.replace(frame, intensities=values))
    return source.truth.cTl, drive, frames


def problem(range_deg: float, samples: int = 100, frames_used: int = 2) -> PeerProblem:
    _, drive, frames = street()
    frames = frames[:frames_used]
    return PeerProblem(frames, drive, 0.0, range_deg, 0.01 * range_deg, samples)


def off(degrees: float) -> gtsam.Pose3:
    """The truth turned about all three axes."""
    return street()[0].retract(np.append(np.radians(degrees) * np.array([0.5, -0.6, 0.6]), np.zeros(3)))


def error(cTl: gtsam.Pose3) -> float:
    return quaternion_angle_deg(cTl.rotation(), street()[0].rotation())


@pytest.mark.parametrize(
    ("name", "start_deg", "left_deg"),
    [("nid", 0.5, 0.25), ("mutual-information", 1.0, 0.25)],
)
def test_a_start_nearby_gets_better(name: str, start_deg: float, left_deg: float) -> None:
    assert error(off(start_deg)) > 0.9 * start_deg
    assert error(PEERS[name].solve(problem(start_deg, frames_used=1), off(start_deg))) < left_deg


def test_depth_edges_find_the_heading() -> None:
    """Scan lines show jumps beside things, which determine the turn about the LiDAR's z axis."""
    truth = street()[0]
    start = truth.retract(np.array([0.0, 0.0, np.radians(1.0), 0.0, 0.0, 0.0]))
    found = solve_depth_edges(problem(1.0), start)
    assert np.degrees(abs(truth.localCoordinates(found)[2])) < 0.25


def test_consistency_of_masks_prefers_the_truth_to_turned_poses() -> None:
    assert error(solve_mask_consistency(problem(4.0), off(4.0))) < 2.0


def test_least_squares_moves_towards_the_truth() -> None:
    assert error(solve_least_squares(problem(2.0), off(2.0))) < 1.5


def test_information_of_independent_and_of_equal_values() -> None:
    """Independent: I = 0, NID = 1. One a function of the other: I = H, NID = 0."""
    independent = np.outer([1.0, 3.0], [2.0, 2.0, 4.0])
    assert statistics.mutual_information(independent) == pytest.approx(0.0, abs=1e-12)
    assert statistics.nid(independent) == pytest.approx(1.0)
    assert statistics.mutual_information(np.diag([1.0, 1.0, 2.0])) == pytest.approx(1.5 * np.log(2.0))
    assert statistics.nid(np.diag([1.0, 1.0, 2.0])) == pytest.approx(0.0, abs=1e-12)
    assert statistics.nid(np.zeros((2, 2))) > 1.0


def test_weights_of_a_point_add_up_to_one() -> None:
    frame = street()[2][0]
    assert frame.intensities is not None
    seen = statistics._Seen(frame, frame.grey, frame.lPs, frame.intensities)
    inside, _ = frame.pixels(street()[0], frame.lPs)
    assert statistics._Knots.of(seen, street()[0]).joint().sum() == pytest.approx(len(inside))
    assert statistics.joint_by_pixel(seen, street()[0]).sum() == len(inside)


def test_the_gradient_of_nid_is_that_of_its_values() -> None:
    frame = street()[2][0]
    assert frame.intensities is not None
    pose = off(1.0)
    # Points whose 4 x 4 pixels lie within the image: at its border a step may lose one.
    inside, uvs = frame.pixels(pose, frame.lPs)
    some = inside[((uvs > 8.0) & (uvs < np.array([612.0, 178.0]))).all(axis=1)]
    seen = statistics._Seen(frame, frame.grey, frame.lPs[some], frame.intensities[some])
    _, gradient = statistics.nid_by_spline(seen, pose)
    h = 1e-6
    ahead = [statistics.nid_by_spline(seen, pose.retract(h * e))[0] for e in np.eye(6)]
    behind = [statistics.nid_by_spline(seen, pose.retract(-h * e))[0] for e in np.eye(6)]
    np.testing.assert_allclose(gradient, np.subtract(ahead, behind) / (2.0 * h), rtol=1e-4, atol=1e-5)


def test_without_intensities_they_refuse() -> None:
    bare = [dataclasses.replace(frame, intensities=None) for frame in street()[2]]
    for name in ("nid", "mutual-information"):
        with pytest.raises(EstimationError, match="no intensities"):
            PEERS[name].solve(dataclasses.replace(problem(1.0), frames=bare), off(1.0))


def test_without_masks_their_consistency_refuses() -> None:
    bare = [dataclasses.replace(f, mask=np.zeros_like(f.mask), instances=None) for f in street()[2]]
    with pytest.raises(EstimationError, match="no masks"):
        solve_mask_consistency(dataclasses.replace(problem(1.0), frames=bare), off(1.0))


def test_what_needs_labels_is_not_run_on_a_drive_without(
    kitti_drive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(kitti_drive / "labels")
    small = ["--streets", "0", "--methods", "joint,semalign", "--set", "ranges_deg=[1]"]
    assert main(["experiment", "peers", "--data", str(kitti_drive.parents[1]), *small]) == 0
    told = capsys.readouterr().out
    assert "| joint | the data hold no labels of points |" in told
    assert "| semalign | the data hold no labels of points |" in told


def test_an_edge_decays_by_gamma_a_pixel() -> None:
    grey = np.zeros((21, 41), np.uint8)
    grey[:, 20:] = 248
    edges = edge_map(grey)
    assert edges[10, 20] == pytest.approx(248.0) and edges[10, 19] == pytest.approx(248.0)
    assert edges[10, 30] == pytest.approx(248.0 * 2.0 / 3.0 * 0.98**10, rel=1e-5)


def test_depth_edges_need_edges() -> None:
    flat = [dataclasses.replace(frame, jumps=np.zeros(len(frame.lPs))) for frame in street()[2]]
    with pytest.raises(EstimationError, match="discontinuity"):
        solve_depth_edges(dataclasses.replace(problem(1.0), frames=flat), off(1.0))


def test_park_and_martin_find_the_rotation_of_exact_motions() -> None:
    rng = np.random.default_rng(0)
    truth = gtsam.Rot3.Expmap(np.array([0.4, -1.0, 2.0]))
    betas = 0.1 * rng.normal(size=(6, 3))
    found = park_martin(betas @ truth.matrix().T, betas)
    assert found.equals(truth, 1e-9)
    with pytest.raises(EstimationError, match="one axis"):
        park_martin(np.outer([0.1, 0.2, 0.3], [0.0, 1.0, 0.0]), np.outer([0.1, 0.2, 0.3], [0.0, 0.0, 1.0]))


def test_the_table_counts_what_failed_and_what_could_not_be_run() -> None:
    config = PeersConfig(ranges_deg=(1.0, 5.0))
    base = PeerRun("a", True, "joint", 1.0, 0.1, 0.01, "ok", 0.05, 2.0, 30.0)
    runs = [
        base,
        dataclasses.replace(base, range_deg=5.0, qad_deg=3.0),
        dataclasses.replace(base, method="scipy", status="", sigma_deg=None),
        dataclasses.replace(base, method="scipy", range_deg=5.0, atd_m=0.5),
        dataclasses.replace(base, method="hand-eye", atd_m=0.5),
        dataclasses.replace(base, method="hand-eye", range_deg=5.0, qad_deg=None, atd_m=None, why_not="none"),
        dataclasses.replace(base, method="nid", qad_deg=None, atd_m=None, why_not="no intensities"),
    ]
    text = markdown(runs, config).replace("\u00a0of\u00a0", " of ")
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert rows[1:] == [
        "| joint | 0.10 / 1.0 / 0 of 1 | 3.00 / 1.0 / 1 of 1 | 1 | 0.05° | 2.0 | 30 |",
        "| scipy *r* | 0.10 / 1.0 / 0 of 1 | 0.10 / 50.0 / 1 of 1 | says nothing | none | 2.0 | 30 |",
        "| hand-eye *r* | 0.10 / – / 0 of 1 | – / – / 1 of 1 | says nothing | none | 2.0 | 30 |",
        "| nid *r* | no intensities | – | – | – | – | – |",
    ]


@pytest.mark.slow
def test_the_command_writes_table_and_figure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    svg, records = tmp_path / "peers.svg", tmp_path / "records"
    small = ["--streets", "1", "--methods", "joint,scipy,nid,hand-eye", "--set", "ranges_deg=[1]"]
    small += ["--set", "street.frames=3", "--set", "street.width=400", "--set", "street.height=120"]
    small += ["--set", f'figure="{svg}"', "--set", f'records="{records}"', "--set", "frames=1"]
    assert main(["experiment", "peers", *small]) == 0
    text, drawn = capsys.readouterr().out, svg.read_bytes()
    assert "| scipy *r* |" in text and "the data tell no intensities" in text
    assert b"<svg" in drawn and str(tmp_path).encode() not in drawn
    assert main(["experiment", "peers", *small]) == 0
    assert capsys.readouterr().out == text and svg.read_bytes() == drawn


def test_a_figure_that_cannot_be_written_costs_no_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, file = tmp_path / "out" / "peers.md", tmp_path / "file"
    file.touch()
    for figure, words in ((file / "peers.svg", "file"), (out, "--out and the figure: found the same file")):
        command = ["experiment", "peers", "--set", f'figure="{figure}"', "--out", str(out)]
        assert main(command) == 2
        told = capsys.readouterr().err
        assert words in told and "runs:" not in told
    assert not list(tmp_path.glob("out/peers*"))


def test_wrong_settings_are_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["experiment", "peers", "--methods", "guess"]) == 2
    assert "levinson-thrun" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="neither"):
        PeersConfig(streets=0)


def test_names_are_those_of_methods() -> None:
    assert len(set(NAMES)) == len(OWN) + len(PEERS)
