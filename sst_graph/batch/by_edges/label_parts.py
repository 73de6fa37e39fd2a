"""Drives that have labels in some of their frames, as two: what is aligned by labels, and what by edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sst_graph.drive.preparation import Drive, ScanFeatures
from sst_graph.files.array_store import replaced
from sst_graph.types import SemanticClass


def split_by_labels(drives: Sequence[Drive]) -> tuple[list[Drive], list[Drive]]:
    """(by labels, by edges) of drives that were prepared for both; those that have nothing are left out.

    A pair of scan and image is aligned by labels where both have some, and by edges elsewhere. A drive of
    which no class occurs on both sides is aligned by edges.
    """
    by_labels, by_edges = [], []
    for drive in drives:
        scans, images = labelled_stamps(drive)
        if scans and images:
            by_labels.append(_of_kind(drive, False))
        if not (len(scans) == len(drive.scans) and len(images) == len(drive.images)):
            by_edges.append(replace(_of_kind(drive, True), labelled_ns=(scans, images)))
    return by_labels, by_edges


def labelled_stamps(drive: Drive) -> tuple[frozenset[int], frozenset[int]]:
    """Stamps of the scans and of the images that have labels; none where no class is on both sides."""
    on_scans = {c for scan in drive.scans for c in scan.boundaries}
    on_images = {c for image in drive.images for c in image.contours}
    if not (on_scans & on_images) - {SemanticClass.OBJECT}:
        return frozenset(), frozenset()
    scans = frozenset(scan.stamp_ns for scan in drive.scans if scan.by_geometry is not None)
    images = frozenset(
        image.stamp_ns for image in drive.images if (image.mask != int(SemanticClass.IGNORE)).any()
    )
    return scans, images


def _of_kind(drive: Drive, by_edges: bool) -> Drive:
    """The drive with the objects without a class alone, or without them."""
    scans = tuple((scan.by_geometry or scan) if by_edges else _by_labels(scan) for scan in drive.scans)
    images = tuple(
        image.with_contours(
            {c: m for c, m in image.contours.items() if (c == SemanticClass.OBJECT) == by_edges}
        )
        for image in drive.images
    )
    return replace(drive, scans=scans, images=images)


def _by_labels(scan: ScanFeatures) -> ScanFeatures:
    """The labelled objects; a scan without labels keeps points, among them the outlines of its objects, for
    they show which labelled objects of the scans around it stand."""
    kept: dict[str, Any] = {"by_geometry": None}
    if SemanticClass.OBJECT in scan.boundaries:
        points = scan.boundaries[SemanticClass.OBJECT]
        kept["boundaries"] = {}
        kept["lPs"] = np.concatenate([scan.lPs, points.lPs])
        kept["offsets_s"] = np.concatenate([scan.offsets_s, points.offsets_s])
        of_objects = np.full(len(points), SemanticClass.OBJECT, np.uint8)
        kept["classes"] = np.concatenate([scan.classes, of_objects])
    return replaced(scan, **kept)
