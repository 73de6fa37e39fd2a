"""The methods of the table: those of this package, and the peers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from sst_graph.experiments.peers.depth_edges import solve_depth_edges
from sst_graph.experiments.peers.frames import Peer
from sst_graph.experiments.peers.hand_eye import solve_hand_eye
from sst_graph.experiments.peers.least_squares import solve_least_squares
from sst_graph.experiments.peers.mask_consistency import solve_mask_consistency
from sst_graph.experiments.peers.statistics import solve_mutual_information, solve_nid

OWN = ("joint", "edges", "paper", "semalign")
"""Methods of the package, by the names that ``calibrate --method`` has; they estimate the time offset too, or
keep it at the guess, which is the true one here."""


@dataclass(frozen=True)
class PeerMethod:
    """A re-implementation.

    Attributes:
        solve: refines a start.
        rotation_only: whether it leaves the translation at the start.
    """

    solve: Peer
    rotation_only: bool = False


PEERS: Mapping[str, PeerMethod] = {
    "nid": PeerMethod(solve_nid),  # direct_visual_lidar_calibration, Koide et al. 2023
    "calib-anything": PeerMethod(solve_mask_consistency),  # CalibAnything, Luo et al. 2023, on given masks
    "levinson-thrun": PeerMethod(solve_depth_edges),  # Levinson and Thrun 2013
    "mutual-information": PeerMethod(solve_mutual_information),  # Pandey et al. 2012
    "scipy": PeerMethod(solve_least_squares),  # the paper's residuals in scipy.optimize.least_squares
    "hand-eye": PeerMethod(solve_hand_eye, rotation_only=True),  # cv2.calibrateHandEye, Park and Martin 1994
}
NAMES = (*OWN, *PEERS)
