"""What the methods of calibration need of a drive, and what of it is missing."""

from __future__ import annotations

from dataclasses import dataclass

from sst_graph.errors import count_of
from sst_graph.types import SemanticClass

WITHOUT_EDGES = (SemanticClass.GROUND, SemanticClass.TERRAIN, SemanticClass.SKY)
"""Classes that stand before nothing else, and so have no edges in a scan."""
_BY_LABELS = ("joint", "both", "paper", "semalign")
_BY_MOTION = ("motion",)
_BY_PICTURES = ("edges", "both", "motion", "paper")
_NO_SEARCH = ("paper", "semalign")
"""Methods that start from a given pose alone."""
_ALIGNED = SemanticClass.VEHICLE.name.lower()
"""Class that is aligned where ``--classes`` names no others."""
METHODS = ("joint", "edges", "both", "motion", "paper", "semalign", "track")


@dataclass(frozen=True)
class Content:
    """What a drive was found to hold.

    Attributes:
        scans, images: their numbers.
        pictures: whether images have pictures, not masks alone.
        point_classes, mask_classes: names of the classes on each side that can be aligned.
        nominal: whether there is a nominal extrinsic.
        black: whether the pictures are black, or nearly.
        together: whether the scans and the images are of one time.
        scans_looked_at, images_looked_at: numbers of those whose classes are known; None: of all.
    """

    scans: int
    images: int
    pictures: bool
    point_classes: frozenset[str]
    mask_classes: frozenset[str]
    nominal: bool
    black: bool = False
    together: bool = True
    scans_looked_at: int | None = None
    images_looked_at: int | None = None


def missing_for(content: Content) -> dict[str, tuple[str, ...]]:
    """For each method what it lacks, in words; nothing where it can be used."""
    return {method: tuple(_missing(method, content)) for method in METHODS}


def _missing(method: str, content: Content) -> list[str]:
    if method == "track":  # its method is auto: by edges where a sensor has no labels
        labelled = content.point_classes and content.mask_classes
        method = "joint" if labelled or not content.pictures else "edges"
    fewest = 2 if method in _BY_MOTION else 1
    found = []
    if content.scans < fewest:
        found.append("scans")
    if content.images < fewest:
        found.append("images")
    if method in _BY_PICTURES and content.images and not content.pictures:
        found.append("pictures")
    if method in _BY_PICTURES and content.black:
        found.append("pictures that are not black (12 bits kept in 16 are to be made 16 times brighter)")
    if method in _BY_LABELS:
        if content.scans and not content.point_classes:
            found.append("labels of points")
        if content.images and not content.mask_classes:
            found.append("semantic masks of images")
        found += _missing_classes(content)
    if content.scans and content.images and not content.together:
        found.append("images of the time of the scans (--init FILE gives the offset between their stamps)")
    if not content.nominal:
        without = "--init FILE gives a start" if method in _NO_SEARCH else "--init none does without"
        found.append(f"a nominal extrinsic ({without})")
    return found


def _missing_classes(content: Content) -> list[str]:
    """What labels lack that are there on both sides: a class on both, or that which is aligned by default."""
    points, masks = content.point_classes, content.mask_classes
    if not (points and masks) or _ALIGNED in points & masks:
        return []
    if not points & masks:
        return ["a class that points and masks both have"]
    sides = []
    if _ALIGNED not in points:
        sides.append(f"points labelled {_ALIGNED}{_where(content.scans_looked_at, content.scans, 'scan')}")
    if _ALIGNED not in masks:
        sides.append(f"pixels labelled {_ALIGNED}{_where(content.images_looked_at, content.images, 'image')}")
    others = sorted((points & masks) - {one.name.lower() for one in (*WITHOUT_EDGES, SemanticClass.OBJECT)})
    remedy = f" (or name other classes: --classes {','.join(others)})" if others else ""
    return [" and ".join(sides) + remedy]


def _where(looked_at: int | None, count: int, what: str) -> str:
    """Which scans or images were looked at, where these are not all."""
    return "" if looked_at is None or looked_at >= count else f" in the {count_of(looked_at, what)} looked at"
