"""The tracker does not start from labels that only repeat its guess."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stored import simulated

from sst_graph import Tracker
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.simulator import SimulationConfig
from sst_graph.types import Frame, SemanticClass


def street() -> KeptDrive:
    config = SimulationConfig(
        seed=741,
        frames=20,
        width=621,
        height=188,
        azimuth_step_deg=0.3,
        azimuth_limit_deg=60.0,
        vehicle_density=0.2,
        motion="no_stop",
        time_offset_s=0.0,
    )
    return KeptDrive.of(simulated(config))


@pytest.mark.slow
def test_labels_that_were_copied_with_the_guess_make_no_start() -> None:
    drive = street()
    assert drive.truth is not None
    camera, start = drive.camera, drive.truth.cTl.retract(np.array([0.01, -0.01, 0.01, 0.05, -0.05, 0.05]))

    def labelled(frame: Frame) -> Frame:
        assert frame.scan is not None and frame.image is not None
        cPs = frame.scan.points @ start.rotation().matrix().T + start.translation()
        uvs = cPs[:, :2] / cPs[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        u, v = np.floor(uvs + 0.5).astype(np.intp).T
        seen = (cPs[:, 2] > 0.5) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        classes = np.full(len(u), SemanticClass.IGNORE, np.uint8)
        classes[seen] = frame.image.mask[v[seen], u[seen]]
        return replace(frame, scan=replace(frame.scan, classes=classes, instances=None))

    tracker = Tracker(camera, initial=start)
    for frame in drive:
        tracker.add(labelled(frame))
    last = tracker.optimize()
    assert last.status == "starting"
    assert "copies of each other" in tracker.initializer.why
