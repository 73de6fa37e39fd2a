"""What an alignment accepts."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from sst_graph.factors import Alignment, FactorError, PinholeCamera

CAMERA = PinholeCamera(700.0, 700.0, 600.0, 180.0, 1242, 375)
GOOD = {
    "lPs": np.ones((4, 3)),
    "base_taus_s": np.zeros(4),
    "pixels": np.ones((4, 2)),
    "sigmas_px": np.ones(4),
    "normals": np.tile([0.6, 0.8], (4, 1)),
}


@pytest.mark.parametrize(
    ("name", "value", "found"),
    [
        ("lPs", np.ones((4, 2)), r"\(4, 2\)"),
        ("lPs", np.full((4, 3), np.nan), "NaN"),
        ("base_taus_s", np.zeros(3), r"\(3,\)"),
        ("pixels", np.ones((3, 2)), r"\(3, 2\)"),
        ("sigmas_px", np.array([1.0, 1.0, 0.0, 1.0]), "0"),
        ("normals", np.ones((4, 2)), "1.41"),
        ("c_acceleration", np.zeros(3), r"\(3,\)"),
        ("motion_model", "se2", "se2"),
        ("weights", -1.0, "-1"),
    ],
)
def test_says_what_is_wrong(name, value, found):
    with pytest.raises(FactorError, match=found) as caught:
        Alignment(CAMERA, **(GOOD | {name: value}))
    assert caught.value.expected


def test_arrays_are_frozen_copies():
    pixels = np.ones((4, 2))
    alignment = Alignment(CAMERA, **(GOOD | {"pixels": pixels}))
    pixels[:] = 7.0
    assert (alignment.pixels == 1.0).all()
    with pytest.raises(ValueError, match="read-only"):
        alignment.pixels[0] = 3.0


def test_numbers_stand_for_all_matches_and_common_times_are_seen():
    alignment = Alignment(CAMERA, **(GOOD | {"base_taus_s": 0.1, "sigmas_px": 2.0}))
    assert alignment.sigmas_px.tolist() == [2.0] * 4
    assert alignment.taus_s(0.2) == pytest.approx(0.3)
    mixed = Alignment(CAMERA, **(GOOD | {"base_taus_s": [0.1, 0.1, 0.1, 0.2]}))
    np.testing.assert_allclose(mixed.taus_s(0.2), [0.3, 0.3, 0.3, 0.4])


def test_travels_to_other_processes():
    alignment = pickle.loads(pickle.dumps(Alignment(CAMERA, **GOOD)))
    assert (alignment.lPs == GOOD["lPs"]).all()
    error = pickle.loads(pickle.dumps(FactorError("x", "y", "z")))
    assert str(error) == "x: found y, expected z"
