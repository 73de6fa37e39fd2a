"""The tracker does not start from labels that only repeat its guess."""

from __future__ import annotations

import numpy as np
import pytest
from copied_labels import labelled_by_mask, street

from sst_graph import Tracker


@pytest.mark.slow
def test_labels_that_were_copied_with_the_guess_make_no_start() -> None:
    drive = street(20, label_noise=1.0)
    assert drive.truth is not None
    camera, start = drive.camera, drive.truth.cTl.retract(np.array([0.01, -0.01, 0.01, 0.05, -0.05, 0.05]))

    tracker = Tracker(camera, initial=start)
    for frame in drive:
        tracker.add(labelled_by_mask(frame, camera, start))
    last = tracker.optimize()
    assert last.status == "starting"
    assert "copies of each other" in tracker.initializer.why
