"""Objects known again from scan to scan, in a time that does not grow with the drive."""

from __future__ import annotations

import time
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest

from sst_graph.association.edge_matching import SIDES
from sst_graph.slam.object_sides import SAME_OBJECT_M, ObjectSides
from sst_graph.types import FloatArray, SemanticClass

VEHICLE, PERSON = SemanticClass.VEHICLE, SemanticClass.PERSON


def tracks_of(sides: ObjectSides, scan_ns: int, centres: dict[SemanticClass, FloatArray]) -> list[list[int]]:
    """Numbers of the objects of a scan, by class; each shows one point."""
    found = SimpleNamespace(
        classes=tuple(centres),
        alignments=[SimpleNamespace(lPs=own) for own in centres.values()],
        objects=[np.arange(len(own)) for own in centres.values()],
        sides=[np.zeros(len(own), np.intp) for own in centres.values()],
    )
    numbers = sides.of(scan_ns, found, gtsam.Pose3())  # type: ignore[arg-type]
    return [(own // SIDES).tolist() for own in numbers]


class Everywhere:
    """Each object against all that there are."""

    def __init__(self) -> None:
        self.tracks: list[tuple[SemanticClass, FloatArray]] = []
        self.names: dict[tuple[int, SemanticClass, int], int] = {}

    def of(self, scan_ns: int, centres: dict[SemanticClass, FloatArray]) -> list[list[int]]:
        return [
            [self.track((scan_ns, c, k), own) for k, own in enumerate(places)]
            for c, places in centres.items()
        ]

    def track(self, name: tuple[int, SemanticClass, int], centre: FloatArray) -> int:
        if name not in self.names:
            taken = {track for other, track in self.names.items() if other[:2] == name[:2]}
            near = [
                (float(np.linalg.norm(place - centre)), k)
                for k, (c, place) in enumerate(self.tracks)
                if c == name[1] and k not in taken
            ]
            distance, nearest = min(near, default=(np.inf, -1))
            self.names[name] = nearest if distance <= SAME_OBJECT_M else len(self.tracks)
            self.tracks += [(name[1], centre)] * (distance > SAME_OBJECT_M)
        self.tracks[self.names[name]] = name[1], centre
        return self.names[name]


def test_the_nearest_of_all_that_the_scan_has_not_named_is_taken() -> None:
    """Dense, so that several are near; scans come again, from elsewhere, as terms that are matched anew."""
    rng, sides, everywhere = np.random.default_rng(0), ObjectSides(), Everywhere()
    again = 0
    for scan_ns in [*range(25), *range(0, 25, 3)]:
        centres = {c: rng.uniform(-4.0, 4.0, (8, 3)) * [1.0, 1.0, 0.3] for c in (VEHICLE, PERSON)}
        before = len(everywhere.tracks)
        expected = everywhere.of(scan_ns, centres)
        assert tracks_of(sides, scan_ns, centres) == expected
        again += sum(number < before for own in expected for number in own)
    assert again > 100 and len(everywhere.tracks) > 30


@pytest.mark.parametrize("step_m", [0.0, 20.0])
def test_a_long_drive_takes_no_longer_a_scan(step_m: float) -> None:
    """Of the same objects, and of others in each scan."""
    sides, seconds = ObjectSides(), []
    for k in range(150):
        centres = np.stack([np.full(10, step_m * k), 5.0 * np.arange(10), np.zeros(10)], axis=1)
        began = time.process_time()
        tracks_of(sides, k, {VEHICLE: centres})
        seconds.append(time.process_time() - began)
    assert min(seconds[-20:]) < 3.0 * min(seconds[5:25])
