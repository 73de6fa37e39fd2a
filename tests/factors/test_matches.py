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
        ("stretches", np.ones(3), r"\(3,\)"),
        ("stretches", np.array([1.0, 2.0, 0.0, 1.0]), "0"),
    ],
)
def test_says_what_is_wrong(name, value, found):
    with pytest.raises(FactorError, match=found) as caught:
        Alignment(CAMERA, **(GOOD | {name: value}))
    assert caught.value.expected


def test_stretches_need_normals():
    with pytest.raises(FactorError, match="no normals"):
        Alignment(CAMERA, **(GOOD | {"normals": None, "stretches": np.ones(4)}))


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


def distinct(**changes):
    """Four matches whose numbers are all different."""
    numbers = iter(range(1, 1000))

    def of(*shape):
        return np.array([next(numbers) for _ in range(int(np.prod(shape)))], float).reshape(shape)

    given = {"lPs": of(4, 3), "base_taus_s": of(4), "pixels": of(4, 2), "sigmas_px": of(4), "weights": of(4)}
    return Alignment(CAMERA, **given | {"l_velocities": of(4, 3), "c_acceleration": of(4, 6)} | changes)


def test_some_of_the_matches_by_position():
    whole, index = distinct(normals=np.tile([0.6, 0.8], (4, 1)) * [[1], [-1], [1], [-1]]), np.array([3, 0])
    some = whole.take(index)
    assert len(some) == 2
    for name in (
        "lPs",
        "base_taus_s",
        "pixels",
        "sigmas_px",
        "weights",
        "l_velocities",
        "c_acceleration",
        "normals",
    ):
        np.testing.assert_array_equal(getattr(some, name), getattr(whole, name)[index])
    one = distinct(c_acceleration=np.arange(6.0), l_velocities=None).take(index)
    assert one.normals is None and one.l_velocities is None
    np.testing.assert_array_equal(one.c_acceleration, np.arange(6.0))


@pytest.mark.parametrize("index", [np.array([0, 4]), np.array([[0, 1]]), np.array(0), "first"])
def test_positions_that_are_none_are_refused(index):
    with pytest.raises(FactorError, match=r"index of take: .*expected positions of some of 4 matches"):
        distinct().take(index)


def test_some_of_the_matches_are_read_only_and_keep_nothing_of_the_others():
    whole = distinct(c_acceleration=np.zeros(6))
    for some in (whole.take(np.array([1, 2])), whole.of_one_image(slice(1, 3), np.ones(6))):
        for name in ("lPs", "base_taus_s", "pixels", "sigmas_px", "weights", "l_velocities"):
            rows = getattr(some, name)
            assert not rows.flags.writeable and rows.base is None


def test_the_acceleration_of_one_image_is_checked():
    with pytest.raises(FactorError, match="c_acceleration of an alignment"):
        distinct().of_one_image(slice(0, 2), np.full(6, np.nan))


def test_the_matches_of_one_image_have_its_acceleration_and_no_velocities_of_zero():
    velocities = np.zeros((4, 3))
    velocities[2, 1] = 1.0
    whole = distinct(l_velocities=velocities)
    one = whole.of_one_image(slice(0, 2), np.ones(6))
    assert one.l_velocities is None and len(one) == 2
    np.testing.assert_array_equal(one.c_acceleration, np.ones(6))
    assert whole.of_one_image(slice(1, 3), np.ones(6)).l_velocities is not None


def test_columns_are_the_rows_turned():
    whole = distinct()
    lPs, pixels, normals = whole.columns
    assert normals is None and whole.rows_per_match == 2
    assert lPs.flags.c_contiguous and pixels.flags.c_contiguous and whole.velocity_columns.flags.c_contiguous
    np.testing.assert_array_equal(lPs, whole.lPs.T)
    np.testing.assert_array_equal(pixels, whole.pixels.T)
    np.testing.assert_array_equal(whole.velocity_columns, whole.l_velocities.T)
    assert Alignment(CAMERA, **GOOD).rows_per_match == 1
    assert Alignment(CAMERA, **GOOD).velocity_columns is None


def test_no_match_at_all_has_no_common_time():
    none = Alignment(CAMERA, np.zeros((0, 3)), 0.1, np.zeros((0, 2)), 1.0, np.zeros((0, 2)))
    assert len(none) == 0 and none.common_tau_s is None


def test_normals_are_unit_vectors_to_a_thousandth():
    for length, ok in ((1.0 + 0.9e-3, True), (1.0 - 1.1e-3, False)):
        normals = np.tile([0.6, 0.8], (4, 1))
        normals[2] *= length
        if ok:
            Alignment(CAMERA, **(GOOD | {"normals": normals}))
        else:
            with pytest.raises(FactorError, match="unit vectors"):
                Alignment(CAMERA, **(GOOD | {"normals": normals}))


@pytest.mark.parametrize(("name", "value"), [("weights", 0.0), ("l_velocities", np.zeros((3, 3)))])
def test_no_weight_of_zero_and_a_velocity_for_each(name, value):
    with pytest.raises(FactorError):
        Alignment(CAMERA, **(GOOD | {name: value}))
