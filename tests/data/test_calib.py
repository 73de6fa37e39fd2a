"""calib.txt: the pose of the LiDAR in the chosen camera, and lines that are not what they must be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sst_graph.data.kitti.calib import pose_from, read_calibration
from sst_graph.errors import ConfigError, DataError

P0 = "P0: 700 0 600 0 0 710 170 0 0 0 1 0"
P2 = "P2: 700 0 600 45 0 710 170 0.2 0 0 1 0.003"
TR = "Tr: 0 -1 0 -0.003 0 0 -1 -0.075 1 0 0 -0.272"


def write(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "calib.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_pose_projects_as_the_devkit_does(tmp_path: Path) -> None:
    calibration = read_calibration(write(tmp_path, P0, P2, TR))
    camera, cTl = calibration.camera("image_2", 1242, 375), calibration.cTl("image_2")
    lPs = np.random.default_rng(3).uniform([5, -5, -2], [40, 5, 2], (20, 3))
    uvs = camera.project(np.array([cTl.transformFrom(lP) for lP in lPs]))
    P = np.array(P2.split()[1:], float).reshape(3, 4)
    Tr = np.vstack([np.array(TR.split()[1:], float).reshape(3, 4), [0, 0, 0, 1]])
    homogeneous = P @ Tr @ np.vstack([lPs.T, np.ones(20)])
    np.testing.assert_allclose(uvs, (homogeneous[:2] / homogeneous[2]).T, atol=1e-9)


def test_camera_zero_has_no_shift(tmp_path: Path) -> None:
    calibration = read_calibration(write(tmp_path, P0, P2, TR))
    np.testing.assert_allclose(calibration.cTl("image_0").translation(), [-0.003, -0.075, -0.272])
    assert calibration.camera("image_0", 1242, 375).fy == 710.0


def test_rounded_rotation_becomes_exact(tmp_path: Path) -> None:
    line = "Tr: 2.3e-04 -9.9994e-01 -1.05e-02 0 1.04e-02 1.05e-02 -9.9989e-01 0 9.9994e-01 1e-04 1.04e-02 0"
    R = read_calibration(write(tmp_path, P0, line)).c0Tl.rotation().matrix()
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(R[0], [2.3e-04, -9.9994e-01, -1.05e-02], atol=2e-4)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ((P0, P2), r"calib\.txt: found no line Tr"),
        ((P0, TR), r"calib\.txt: found no line P2, expected the projection matrix of image_2"),
        ((P2 + " 7", TR), r"calib\.txt:1: found 13 values for P2, expected 12"),
        ((P2, "Tr: 1 2 3"), r"calib\.txt:2: found 3 values for Tr, expected 12"),
        ((P2, TR.replace("-0.075", "x")), r"calib\.txt:2: found 'x' in Tr, expected 12 numbers"),
        ((P2, TR.replace("-0.075", "nan")), r"calib\.txt:2: found NaN or inf in Tr"),
        ((P2, TR.replace("0 -1 0", "0 -1.1 0")), r"\(Tr\): found a 3x3 block with \|R R' - I\| = 0\.21"),
        ((P2, TR.replace("0 -1 0", "0 1 0")), r"\(Tr\): found a 3x3 block .* det -1, expected a rotation"),
        ((P2, TR.replace("-0.272", "-272000")), r"found a translation of 2.72e\+05 m"),
        ((P2.replace("45", "4e9"), TR), r"shift of image_2\): found a translation"),
        ((P2.replace("700", "1e300"), TR), r"found P2 = .* expected \[fx 0 cx"),
        ((P2.replace("700", "5e-324"), TR), r"found P2 = .* expected \[fx 0 cx"),
        ((P2.replace("700", "0"), TR), r"found P2 = .* expected \[fx 0 cx"),
        ((P2.replace("P2: 700 0", "P2: 700 3"), TR), r"found P2 = .* expected \[fx 0 cx"),
    ],
)
def test_bad_lines_are_named(tmp_path: Path, lines: tuple[str, ...], message: str) -> None:
    with pytest.raises(DataError, match=message) as caught:
        read_calibration(write(tmp_path, *lines)).cTl("image_2")
    assert "\n" not in str(caught.value)


def test_missing_or_binary_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"calib\.txt: found no such file"):
        read_calibration(tmp_path / "calib.txt")
    (tmp_path / "calib.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match="no UTF-8 text"):
        read_calibration(tmp_path / "calib.txt")


@pytest.mark.parametrize("name", ["left", "image_x", "velodyne"])
def test_camera_name_must_be_image_n(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="expected image_N"):
        read_calibration(write(tmp_path, P2, TR)).cTl(name)


def test_matrices_that_are_no_pose() -> None:
    with pytest.raises(DataError, match=r"x: found an array of shape \(3, 3\)"):
        pose_from(np.eye(3), "x")
    with pytest.raises(DataError, match=r"last row \[0\.0, 0\.0, 0\.0, 2\.0\]"):
        pose_from(np.diag([1.0, 1, 1, 2]), "x")
    translated = np.eye(4)
    translated[0, 3] = np.inf
    with pytest.raises(DataError, match="not finite"):
        pose_from(translated, "x")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("700", "1e9", r"fx = 1e\+09 px, expected a focal length of"),
        ("710", "1e9", r"fy = 1e\+09 px"),
        ("700", "3", r"fx = 3 px"),
        ("700", "60000", "differ by a factor of at most 5"),
        ("600", "9000", r"cx = 9000 px, expected a principal point of -1242 to 2484 px"),
        ("170", "-400", r"cy = -400 px"),
    ],
)
def test_intrinsics_must_go_with_the_image(tmp_path: Path, old: str, new: str, message: str) -> None:
    calibration = read_calibration(write(tmp_path, P2.replace(old, new), TR))
    with pytest.raises(DataError, match=message):
        calibration.camera("image_2", 1242, 375)
