"""What is aligned by labels, and what by edges: of a scan that comes, and of the window as a drive."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection

import numpy as np

from sst_graph.drive.preparation import Drive, ScanFeatures
from sst_graph.types import SemanticClass

EDGE_KERNEL_SHARE = 0.4
"""Scale of the kernel of edges, over that of the contours of masks: 1.2 px at the end, as in the batch."""


def by_edges(classes: Collection[SemanticClass]) -> bool:
    """Whether edges of objects without a class are aligned, too."""
    return SemanticClass.OBJECT in classes


def by_labels(classes: Collection[SemanticClass]) -> bool:
    """Whether any class has labels."""
    return any(c != SemanticClass.OBJECT for c in classes)


def both_kinds(scan: ScanFeatures) -> ScanFeatures:
    """A scan with its labelled objects and, beside them, those without a class."""
    edges = scan.by_geometry
    if edges is None:
        return scan
    own = np.flatnonzero(edges.classes == int(SemanticClass.OBJECT))
    return dataclasses.replace(
        scan,
        boundaries={**scan.boundaries, **edges.boundaries},
        lPs=np.concatenate([scan.lPs, edges.lPs[own]]),
        classes=np.concatenate([scan.classes, edges.classes[own]]),
        offsets_s=np.concatenate([scan.offsets_s, edges.offsets_s[own]]),
        by_geometry=None,
    )


def of_kind(drive: Drive, edges: bool) -> Drive:
    """The drive with the boundary points of objects without a class alone, or of labelled ones."""
    scans = tuple(
        dataclasses.replace(
            scan,
            boundaries={c: b for c, b in scan.boundaries.items() if (c == SemanticClass.OBJECT) == edges},
        )
        for scan in drive.scans
    )
    return dataclasses.replace(drive, scans=scans)
