"""Labels kept on disk, by what was labelled and by the network that did it.

A folder of labels holds::

    images/MODEL/model.json       name, identity and classes of a network
    images/MODEL/KEY.png          mask of a picture, Cityscapes ids
    images/MODEL/KEY.instances.png  where the network tells instances: uint16, class * 256 + number
    scans/MODEL/KEY.label         labels of a scan as in SemanticKITTI, one uint32 a point

MODEL is the beginning of a network's identity, KEY a digest of the picture's pixels or of the scan's points
and intensities: labels are found again whatever the drive is called, cut or shifted to, and those of another
picture never are. Every file appears whole or not at all, so that a run that was killed goes on where it was.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.classes import (
    MaskEncoding,
    cityscapes_ids_of,
    classes_of_mask,
    classes_of_points,
    semantic_kitti_of,
)
from sst_graph.data.arrays import listed, read_labels
from sst_graph.data.images import read_instances, read_mask
from sst_graph.errors import ConfigError, DataError, count_of
from sst_graph.files import atomic_write_bytes, atomic_write_text, sweep_folder
from sst_graph.files.reading import FileKind, read_json
from sst_graph.files.staging import SUFFIX
from sst_graph.segmentation.segmenter import ImageLabels, PointLabels, Segmenter
from sst_graph.types import CameraImage, Scan, SemanticClass, intensities_of

Side = Literal["images", "scans"]
FORMAT = "sst-graph/labels"
VERSION = 1
_MODEL_FILE = "model.json"
_MODEL = FileKind("the model.json of stored labels", 64 * 1024)
_INSTANCES = ".instances.png"
_MOST_INSTANCES = 255
"""Of a class, by 8 bits of a number."""
_DIGITS = 16
"""Of a network's identity in the name of its folder: 2^-32 for a collision among 65,000 networks."""


@dataclass(frozen=True)
class StoredModel:
    """A network whose labels are stored.

    Attributes:
        name: for people.
        identity: as of its segmenter.
        known: classes that it tells from others.
    """

    name: str
    identity: str
    known: frozenset[SemanticClass]


def cache_folder() -> Path:
    """Where labels are kept if no folder is named: ``sst-graph/labels`` in the user's cache."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if os.path.isabs(base) else Path.home() / ".cache") / "sst-graph" / "labels"


@dataclass(frozen=True)
class LabelStore:
    """A folder of labels."""

    folder: Path

    def models(self, side: Side) -> list[StoredModel]:
        """Networks that have a place here, also those of which no label is stored yet.

        Raises:
            DataError: a model.json that is damaged.
        """
        folder = self.folder / side
        if not folder.is_dir():
            return []
        places = [place for place in listed(folder, "folders of networks") if place.is_dir()]
        return [_stored_model(place / _MODEL_FILE) for place in places if (place / _MODEL_FILE).exists()]

    def only_model(self, side: Side) -> StoredModel | None:
        """The network whose labels are stored, or None.

        Raises:
            ConfigError: there are several.
        """
        models = [model for model in self.models(side) if self._has_labels(side, model.identity)]
        if len(models) > 1:
            named = ", ".join(f"{one.name} ({one.identity[:_DIGITS]})" for one in models)
            option = "--image-model" if side == "images" else "--lidar-model"
            raise ConfigError(
                f"{self.folder}: found labels of {count_of(len(models), 'network')} ({named}): give {option}"
            )
        return models[0] if models else None

    def is_begun(self) -> bool:
        """Whether it is empty, or as a run leaves it that ends before its first label."""
        if {entry.name for entry in self.folder.iterdir()} - {"images", "scans"}:
            return False
        names = (name for _, _, files in os.walk(self.folder) for name in files)
        return all(name.endswith(SUFFIX) for name in names)

    def enter(self, side: Side, segmenter: Segmenter) -> StoredModel:
        """Make a place for the labels of a network; what a killed run left half-written there is removed."""
        model = StoredModel(segmenter.name, segmenter.identity, segmenter.known)
        path = self._place(side, model.identity) / _MODEL_FILE
        if not path.exists():
            known = sorted(one.name.lower() for one in model.known)
            content = {"format": FORMAT, "version": VERSION, "name": model.name, "identity": model.identity}
            atomic_write_text(path, json.dumps({**content, "classes": known}, indent=1) + "\n")
        sweep_folder(path.parent)
        return model

    def image(self, model: str, image: CameraImage) -> ImageLabels | None:
        """Stored labels of a picture, or None.

        Args:
            model: identity of the network.

        Raises:
            DataError: a file is damaged.
        """
        path = self._image_path(model, image)
        if not path.exists():
            return None
        size = (image.pixels.shape[1], image.pixels.shape[0])
        mask = classes_of_mask(read_mask(path, size), MaskEncoding.IDS, path)
        numbered = _instances_path(path)
        return ImageLabels(mask, read_instances(numbered, size) if numbered.exists() else None)

    def put_image(self, model: str, image: CameraImage, labels: ImageLabels) -> None:
        """Store the labels of a picture, but for instances of what has none in Cityscapes, such as OTHER.

        Raises:
            DataError: an instance number above 255, or a class that cannot be stored.
        """
        path = self._image_path(model, image)
        ids = cityscapes_ids_of(labels.mask)
        if labels.instances is not None:
            if (most := int(labels.instances.max(initial=0))) > _MOST_INSTANCES:
                place = f"the image stamped {image.stamp_ns} ns"
                raise DataError(place, f"instance {most}", f"at most {_MOST_INSTANCES} a class")
            numbered = np.where(labels.instances > 0, ids.astype(np.uint16) * 256 + labels.instances, 0)
            # Before the mask: where that is found, nothing is missing.
            atomic_write_bytes(_instances_path(path), _png(numbered.astype(np.uint16)))
        atomic_write_bytes(path, _png(ids))

    def scan(self, model: str, scan: Scan) -> PointLabels | None:
        """Stored labels of a scan, or None.

        Args:
            model: identity of the network.

        Raises:
            DataError: a file is damaged.
        """
        path = self._scan_path(model, scan)
        if not path.exists():
            return None
        classes, instances = classes_of_points(read_labels(path, len(scan.points)), path)
        return PointLabels(classes, instances if instances.any() else None)

    def put_scan(self, model: str, scan: Scan, labels: PointLabels) -> None:
        """Store the labels of a scan; SKY becomes OTHER."""
        numbers = semantic_kitti_of(labels.classes, labels.instances)
        atomic_write_bytes(self._scan_path(model, scan), numbers.astype("<u4").tobytes())

    def _has_labels(self, side: Side, model: str) -> bool:
        """Whether the labels of a picture or a scan are stored, whole."""
        place = self._place(side, model)
        names = (file.name for file in place.iterdir()) if place.is_dir() else ()
        suffix = ".png" if side == "images" else ".label"
        return any(name.endswith(suffix) and not name.endswith(_INSTANCES) for name in names)

    def _place(self, side: Side, model: str) -> Path:
        return self.folder / side / model[:_DIGITS]

    def _image_path(self, model: str, image: CameraImage) -> Path:
        return self._place("images", model) / f"{_key(image.pixels)}.png"

    def _scan_path(self, model: str, scan: Scan) -> Path:
        intensities = intensities_of(scan)
        arrays = (scan.points,) if intensities is None else (scan.points, intensities)
        return self._place("scans", model) / f"{_key(*arrays)}.label"


def _instances_path(path: Path) -> Path:
    return path.with_suffix(_INSTANCES)


def _key(*arrays: NDArray[Any]) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for array in arrays:
        digest.update(f"{array.dtype.str} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _png(image: NDArray[Any]) -> bytes:
    _, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return bytes(data.tobytes())


def _stored_model(path: Path) -> StoredModel:
    table = read_json(path, _MODEL)
    names = {one.name.lower(): one for one in SemanticClass}
    try:
        if not isinstance(table, Mapping) or table["format"] != FORMAT or table["version"] != VERSION:
            raise KeyError("format")
        known = frozenset(names[name] for name in table["classes"])
        return StoredModel(str(table["name"]), str(table["identity"]), known)
    except (KeyError, TypeError) as error:
        raise DataError(path, f"no {error} as expected", f"{_MODEL.name}, version {VERSION}") from None
