"""A small version of studies/fleet.py: a knocked vehicle, three bad drives, processes killed at random."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np
import pytest

from studies import fleet


@pytest.mark.skipif(sys.platform != "linux", reason="finds processes by /proc")
@pytest.mark.slow
def test_a_killed_batch_finds_the_knock_and_has_the_same_bytes(tmp_path: Path) -> None:
    folder, batch, alone = tmp_path / "drives", tmp_path / "batch", tmp_path / "alone"
    drives = fleet.make_fleet(folder, [2], 5)
    bad = fleet.add_bad_drives(folder)
    assert fleet.CHANGES["v02"].before == 3
    command = fleet.batch_command(folder, batch)
    killed = fleet.run_with_kills(command, np.random.default_rng(0), 4.0, 1)
    assert killed.batches == 1 and killed.drives >= 1
    code, _, _ = fleet.run_batch(command)
    assert code == 3
    with open(batch / "summary.csv", newline="") as stream:
        status = {row["drive"]: row["status"] for row in csv.DictReader(stream)}
    assert {status[path.name] for path in bad} == {"bad_input"}
    assert {status[path.name] for path in drives} <= {"ok", "unobservable"}
    with open(batch / "vehicles.csv", newline="") as stream:
        found = {row["vehicle"]: row for row in csv.DictReader(stream)}
    assert found["v02"]["changes"] == "1" and found["v02"]["contradicting"] == "0"
    assert f"between {drives[2].name} and {drives[3].name}" in found["v02"]["reason"]
    assert "(yaw)" in found["v02"]["reason"]
    fleet.calibrate_one_by_one(drives[:2], alone)
    for drive in drives[:2]:
        assert fleet.unlike(alone / drive.name, batch / "drives" / drive.name) == []
