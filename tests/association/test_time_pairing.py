"""Scans and the images closest to them in true time."""

from __future__ import annotations

import numpy as np
import pytest

from sst_graph.association.time_pairing import Pair, nearest_images, pair_by_time, pair_every_image

EPOCH_NS = 1_700_000_000_000_000_000


def stamps(*seconds: float) -> list[int]:
    return [EPOCH_NS + round(1e9 * t) for t in seconds]


def test_sign_of_the_offset() -> None:
    # Images stamped 0.2 s early: an image stamped 0.0 shows the world at LiDAR time 0.2.
    pairs = pair_by_time(stamps(0.0, 0.1, 0.2, 0.3), stamps(0.0, 0.1), 0.2, 0.05)
    assert [(pair.scan, pair.image) for pair in pairs] == [(2, 0), (3, 1)]
    for pair in pairs:
        assert pair.base_tau_s == pytest.approx(-0.2, abs=1e-12)
        assert 0.2 + pair.base_tau_s == pytest.approx(0.0, abs=1e-12)


def test_far_pairs_are_left_out() -> None:
    scans, images = stamps(0.0, 0.1, 1.0), stamps(0.03, 0.16)
    assert [(p.scan, p.image) for p in pair_by_time(scans, images, 0.0, 0.05)] == [(0, 0)]
    assert [(p.scan, p.image) for p in pair_by_time(scans, images, 0.0, 0.065)] == [(0, 0), (1, 1)]
    assert [(p.scan, p.image) for p in pair_by_time(scans, images, 0.0, 2.0)] == [(0, 0), (1, 1), (2, 1)]


def test_nothing_and_one() -> None:
    assert pair_by_time([], stamps(0.0), 0.0, 1.0) == []
    assert pair_by_time(stamps(0.0), [], 0.0, 1.0) == []
    (pair,) = pair_by_time(stamps(0.5), stamps(0.25), 0.0, 1.0)
    assert pair == Pair(0, 0, pytest.approx(-0.25))


@pytest.mark.parametrize("seed", range(10))
def test_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scans = stamps(*np.sort(rng.uniform(0.0, 5.0, 30)))
    images = stamps(*np.sort(rng.uniform(0.0, 5.0, rng.integers(1, 40))))
    offset, limit = rng.uniform(-0.5, 0.5), 0.1
    expected = []
    for k, scan in enumerate(scans):
        taus = [(image - scan) * 1e-9 + offset for image in images]
        nearest = int(np.argmin(np.abs(taus)))
        if abs(taus[nearest]) <= limit:
            expected.append((k, nearest, taus[nearest] - offset))
    found = pair_by_time(scans, images, offset, limit)
    assert [(p.scan, p.image) for p in found] == [(k, j) for k, j, _ in expected]
    assert [p.base_tau_s for p in found] == pytest.approx([tau for _, _, tau in expected], abs=1e-12)


def test_many_offsets_at_once_are_each_by_itself() -> None:
    rng = np.random.default_rng(7)
    scans, images = stamps(*np.sort(rng.uniform(0.0, 2.0, 20))), stamps(*np.sort(rng.uniform(0.2, 1.8, 15)))
    offsets_s = rng.uniform(-0.5, 0.5, 40)
    found, base_taus_s = nearest_images(scans, images, offsets_s, 0.1)
    assert found.shape == base_taus_s.shape == (40, 20)
    for own, taus, time_offset_s in zip(found, base_taus_s, offsets_s.tolist(), strict=True):
        pairs = pair_by_time(scans, images, time_offset_s, 0.1)
        assert [(p.scan, p.image, p.base_tau_s) for p in pairs] == [
            (k, own[k], taus[k]) for k in np.flatnonzero(own >= 0)
        ]
        # The nearest of all, and only where it is near.
        for k, stamp in enumerate(scans):
            apart = [abs(1e-9 * (image - stamp) + time_offset_s) for image in images]
            assert own[k] == (int(np.argmin(apart)) if min(apart) <= 0.1 else -1)


@pytest.mark.parametrize("seed", range(5))
def test_every_image_with_its_nearest_scan(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scans = stamps(*np.sort(rng.uniform(0.0, 3.0, 20)))
    images = stamps(*np.sort(rng.uniform(0.0, 3.0, 70)))
    time_offset_s = rng.uniform(-0.5, 0.5)
    expected = []
    for j, image in enumerate(images):
        taus = [(image - scan) * 1e-9 + time_offset_s for scan in scans]
        nearest = int(np.argmin(np.abs(taus)))
        if abs(taus[nearest]) <= 0.06:
            expected.append((nearest, j, taus[nearest] - time_offset_s))
    found = pair_every_image(scans, images, time_offset_s, 0.06)
    assert [(p.scan, p.image) for p in found] == [(k, j) for k, j, _ in expected]
    assert [p.base_tau_s for p in found] == pytest.approx([tau for _, _, tau in expected], abs=1e-12)
    assert pair_every_image([], images, 0.0, 1.0) == pair_every_image(scans, [], 0.0, 1.0) == []
