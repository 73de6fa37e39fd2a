"""The third simulator is what it says it is."""

from __future__ import annotations

import dataclasses

import numpy as np

from sst_graph.types import SemanticClass
from studies.simulators.third_street import Hits, Solid, ThirdConfig, ThirdStreet, cast

EXACT = ThirdConfig(
    seed=3,
    frames=1,
    motion="standing",
    time_offset_s=0.0,
    label_noise=0.0,
    width=621,
    height=188,
    focal_px=360.0,
)


def _facing(divergence_mrad: float) -> ThirdStreet:
    """A street with nothing in it but a wall 10 m ahead, to the left of the x axis, and one far behind it."""
    config = dataclasses.replace(EXACT, losses=False, range_noise_m=0.0, lasers="16", width=64, height=32)
    street = ThirdStreet(dataclasses.replace(config, divergence_mrad=divergence_mrad))
    box = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 6.0) for z in (0.0, 6.0)])
    near = Solid(box + np.array([10.0, 0.0, 0.0]), SemanticClass.VEHICLE, 1, 0.3)
    far = Solid(box * [1.0, 10.0, 1.0] + [30.0, -30.0, 0.0], SemanticClass.BUILDING, 2, 0.3)
    street.solids = [near, far]
    return street


def _edge_rad(street: ThirdStreet, k: int) -> float:
    """Azimuth at which the near wall ends, half way between the last beam on it and the next."""
    scan = street[k].scan
    assert scan is not None
    level = np.abs(scan.points[:, 2]) < 1.0
    azimuths = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    vehicle = scan.classes == SemanticClass.VEHICLE
    beside = level & ~vehicle & (azimuths < 0.2)
    return float(0.5 * (azimuths[level & vehicle].min() + azimuths[beside].max()))


def test_a_ray_meets_a_box_where_it_enters() -> None:
    box = np.array([[x, y, z] for x in (5.0, 7.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    planes = Solid(box, SemanticClass.VEHICLE, 1, 0.5).planes
    assert len(planes) == 6
    rays = np.array([[1.0, 0.0, 0.0], [1.0, 0.3, 0.0], [-1.0, 0.0, 0.0]])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    hits: Hits = cast([planes], np.zeros(3), rays[:, None, None], [(slice(None), slice(None))])
    assert hits.solids[:, 0, 0].tolist() == [0, -2, -2]
    assert np.isclose(hits.ranges[0, 0, 0], 5.0)


def test_beams_widen_what_is_near() -> None:
    """A seventh of a beam is enough where the other wall answers nine times as faintly: the edge moves out by
    0.66 of the beam's half width."""
    # The beams of every scan start elsewhere.
    walls = _facing(0.0), _facing(8.0)
    edges = [np.mean([_edge_rad(street, k) for k in range(24)]) for street in walls]
    assert abs(edges[0]) < 0.001
    assert 0.0018 < edges[0] - edges[1] < 0.0034


def test_points_and_masks_agree() -> None:
    """At exact labels, true pose and ideal rays, points of vehicles fall on vehicles."""
    street = ThirdStreet(dataclasses.replace(EXACT, rays=1, width=1242, height=375, focal_px=721.5))
    frame = street[0]
    assert frame.scan is not None and frame.image is not None
    cTl = street.truth.cTl
    cPs = frame.scan.points @ cTl.rotation().matrix().T + cTl.translation()
    uvs = street.camera.project(cPs)
    seen = street.camera.in_image(np.nan_to_num(uvs, nan=-9.0))
    columns, rows = np.round(uvs[seen]).astype(int).T
    expected, found = frame.scan.classes[seen], frame.image.mask[rows, columns]
    # The camera sits lower: vehicles hide from it some of the walls that the LiDAR sees.
    for label, share in (
        (SemanticClass.VEHICLE, 0.98),
        (SemanticClass.GROUND, 0.98),
        (SemanticClass.BUILDING, 0.9),
    ):
        assert np.count_nonzero(expected == label) > 500
        assert np.mean(found[expected == label] == label) > share
