"""Poses between cameras from Kalibr's camchain and KITTI's calib.txt."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest

from sst_graph.errors import DataError
from sst_graph.rig.known_files import read_known_poses

LINK_1 = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.01, 0.02, 0.03), np.array([-0.5, 0.01, 0.02]))
LINK_2 = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 0.3), np.array([0.1, -0.3, 0.2]))


def _rows(pose: gtsam.Pose3) -> str:
    return "".join(f"  - {row}\n" for row in pose.matrix().tolist())


@pytest.fixture
def chain(tmp_path: Path) -> Path:
    """As Kalibr writes it, intrinsics left out of all but the first."""
    path = tmp_path / "camchain.yaml"
    path.write_text(
        "cam0:\n  intrinsics: [461.6, 460.1, 366.5, 248.6]\n  rostopic: /cam0/image\n"
        f"cam1:\n  T_cn_cnm1:\n{_rows(LINK_1)}  rostopic: /cam1/image\n"
        f"cam2:\n  T_cn_cnm1:\n{_rows(LINK_2)}  rostopic: /cam2/image\n"
    )
    return path


def test_neighbours_of_a_chain(chain: Path) -> None:
    one, two = read_known_poses(chain, ["cam0", "cam1", "cam2"], 0.02, 0.001)
    assert (one.camera, one.reference) == ("cam1", "cam0")
    assert one.T_camera_reference.equals(LINK_1, 1e-9)
    assert (two.camera, two.reference) == ("cam2", "cam1")
    assert two.T_camera_reference.equals(LINK_2, 1e-9)
    assert (one.rotation_sigma_deg, one.translation_sigma_m) == (0.02, 0.001)


def test_links_add_up_and_topics_name_cameras(chain: Path) -> None:
    """The order is the chain's, not that of the command line."""
    (pose,) = read_known_poses(chain, ["/cam2/image", "/cam0/image"], 0.02, 0.001)
    assert (pose.camera, pose.reference) == ("/cam2/image", "/cam0/image")
    assert pose.T_camera_reference.equals(LINK_2 * LINK_1, 1e-9)
    assert pose.rotation_sigma_deg == pytest.approx(0.02 * np.sqrt(2))


@pytest.mark.parametrize(
    ("cameras", "topics"),
    [
        (("left", "right"), ("/left/image_raw", "/right/image_raw")),
        (("left/image_raw", "right/image_raw"), ("/left/image_raw", "/right/image_raw")),
        (("image_2", "image_3"), ("/image_2", "/image_3")),  # so export writes the cameras of folders
    ],
)
def test_a_topic_names_a_camera_without_its_slash_and_by_its_namespace(
    tmp_path: Path, cameras: tuple[str, str], topics: tuple[str, str]
) -> None:
    path = tmp_path / "camchain.yaml"
    link = f"T_cn_cnm1:\n{_rows(LINK_1)}"
    path.write_text(f"cam0:\n  rostopic: {topics[0]}\ncam1:\n  rostopic: {topics[1]}\n  {link}")
    (pose,) = read_known_poses(path, cameras)
    assert (pose.camera, pose.reference) == (cameras[1], cameras[0])
    assert pose.T_camera_reference.equals(LINK_1, 1e-9)


def test_a_name_of_a_table_that_is_another_one_s_topic_is_ambiguous(tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    swapped = "rostopic: /cam1/image\ncam1:\n  rostopic: /cam0/image"
    path.write_text(f"cam0:\n  {swapped}\n  T_cn_cnm1:\n{_rows(LINK_1)}")
    with pytest.raises(DataError, match="cam0 twice"):
        read_known_poses(path, ["cam0", "cam1"])


def test_names_of_the_data_set(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(f"image_2: {{}}\nimage_3:\n  T_cn_cnm1:\n{_rows(LINK_1)}")
    (pose,) = read_known_poses(path, ["image_2", "image_3"])
    assert pose.T_camera_reference.equals(LINK_1, 1e-9)


def test_p_lines_of_kitti(tmp_path: Path) -> None:
    """The right colour camera stands 0.533 m to the right of the left one."""
    path = tmp_path / "calib.txt"
    K = "721.5377 0 609.5593 {} 0 721.5377 172.854 {} 0 0 1 {}"
    lines = {
        "P2": K.format(44.85728, 0.2163791, 0.002745884),
        "P3": K.format(-339.5242, 2.199936, 0.002729905),
    }
    text = "".join(f"{name}: {values}\n" for name, values in lines.items())
    path.write_text(text + "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    (pose,) = read_known_poses(path, ["image_2", "image_3"])
    np.testing.assert_allclose(pose.T_camera_reference.translation(), [-0.5327, 0.00275, 0], atol=2e-4)
    assert pose.T_camera_reference.rotation().equals(gtsam.Rot3(), 1e-12)


@pytest.mark.parametrize(
    ("text", "cameras", "found"),
    [
        (None, ["cam0", "cam7"], r"cam0 \(/cam0/image\).*expected one of the name or rostopic cam7"),
        ("cam0: {}\ncam1: {}\n", ["cam0", "cam1"], "no T_cn_cnm1"),
        ("cam0: {}\ncam1: {T_cn_cnm1: [1, 2]}\n", ["cam0", "cam1"], "2 numbers"),
        (
            "cam0: {}\ncam1:\n  T_cn_cnm1: [[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]\n",
            ["cam0", "cam1"],
            "cam1",
        ),
        ("cam0: {rostopic: /a}\ncam1: {rostopic: /a}\n", ["/a"], "T_cn_cnm1"),
        ("a: 1\n", ["a", "b"], "cameras none"),
        ("- 1\n", ["a", "b"], "YAML list"),
    ],
)
def test_chains_that_cannot_be_used(
    chain: Path, tmp_path: Path, text: str | None, cameras: list[str], found: str
) -> None:
    path = chain
    if text is not None:
        path = tmp_path / "other.yaml"
        path.write_text(text)
    with pytest.raises(DataError, match=found):
        read_known_poses(path, cameras)
