"""What holds on the project's own simulator holds on two others."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph import calibrate
from sst_graph.experiments.starts import error_of
from sst_graph.types import SemanticClass
from studies.simulators.second_street import SecondStreet, StreetConfig
from studies.simulators.third_street import ThirdConfig, ThirdStreet


def test_points_and_masks_agree() -> None:
    """At exact labels, and at true pose and time, points of vehicles fall on vehicles."""
    street = SecondStreet(StreetConfig(seed=2, frames=2, label_noise=0.0, time_offset_s=0.0))
    frame = street[1]
    cTl = street.truth.cTl
    cPs = frame.scan.points @ cTl.rotation().matrix().T + cTl.translation()
    uvs = street.camera.project(cPs)
    seen = street.camera.in_front(cPs) & street.camera.in_image(np.nan_to_num(uvs, nan=-9.0))
    columns, rows = np.round(uvs[seen]).astype(int).T
    expected, found = frame.scan.classes[seen], frame.image.mask[rows, columns]
    for label in (SemanticClass.VEHICLE, SemanticClass.GROUND, SemanticClass.BUILDING):
        assert np.count_nonzero(expected == label) > 500
        # Range noise and the painter's order leave a few at the edges.
        assert np.mean(found[expected == label] == label) > 0.98


@pytest.mark.slow
@pytest.mark.parametrize(
    ("street", "away"),
    [
        (
            SecondStreet(StreetConfig(seed=2, frames=12, width=960, height=320, focal_px=540.0)),
            (0.1, -0.12, 0.15, 0.08, -0.06, 0.05),
        ),
        (
            ThirdStreet(ThirdConfig(seed=2, frames=10, width=828, height=250, focal_px=480.0)),
            (0.08, -0.1, 0.12, 0.06, -0.05, 0.05),
        ),
    ],
    ids=["second", "third"],
)
def test_a_street_with_a_stop(street: SecondStreet | ThirdStreet, away: tuple[float, ...]) -> None:
    result = calibrate(street, street.truth.cTl * gtsam.Pose3.Expmap(np.array(away)))
    assert result.status != "not_converged"
    error = error_of(result.calibration, street.truth)
    assert np.degrees(np.linalg.norm(error[:3])) < 0.3
    assert error @ np.linalg.solve(result.covariance, error) < 3.0 * 7
