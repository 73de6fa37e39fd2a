"""Labels by networks, as the command line asks for them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sst_graph.cli.messages import complain
from sst_graph.data.info.methods import WITHOUT_EDGES
from sst_graph.errors import ConfigError
from sst_graph.types import SemanticClass, Source

if TYPE_CHECKING:
    from sst_graph.segmentation import ImageSegmenter, Labelling, LabelStore, ScanSegmenter

LABEL_OPTIONS = ("image_model", "lidar_model", "labels")
"""Options that say what labels a drive."""
ALIGNABLE = tuple(
    label
    for label in SemanticClass
    if label not in (SemanticClass.OTHER, SemanticClass.IGNORE, SemanticClass.OBJECT)
)
"""Classes that ``--classes`` takes."""
_OF_OBJECTS = tuple(label for label in ALIGNABLE if label not in WITHOUT_EDGES)
"""Classes of objects: they stand before something else, and so have edges in a scan."""


def labelled(source: Source, options: Mapping[str, Any]) -> Source:
    """The drive with labels as the options say; as it is where they say nothing.

    Raises:
        ConfigError, DataError: a network or a folder of labels that cannot be used.
        MissingDependencyError: what a network runs by is not installed.
    """
    image_model, lidar_model, folder = (options.get(name) for name in LABEL_OPTIONS)
    if image_model is None and lidar_model is None and folder is None:
        return source
    from sst_graph.segmentation import with_labels

    if folder is not None and (image_model is not None or lidar_model is not None):
        store_to_fill(Path(folder))
    return with_labels(source, image_segmenter(image_model), scan_segmenter(lidar_model), folder)


def check_classes(sources: Sequence[Source], classes: Sequence[SemanticClass], asked: str | None) -> None:
    """Require networks that know the classes to be aligned.

    Args:
        asked: what ``--classes`` says; of "all" each network may know some.

    Raises:
        ConfigError: a class that a network does not tell from others.
    """
    for source in sources:
        labelling: Labelling | None = getattr(source, "labelling", None)
        for model in (labelling.images, labelling.scans) if labelling is not None else ():
            if model is None:
                continue
            missing = [one.name.lower() for one in classes if one not in model.known]
            if missing and (asked != "all" or len(missing) == len(classes)):
                known = ", ".join(sorted(one.name.lower() for one in model.known)) or "none"
                raise ConfigError(
                    f"{model.name}: found no {missing[0]} among its classes ({known}), expected all that are "
                    "to be aligned (--classes)"
                )


def expect_alignable(segmenters: Sequence[ImageSegmenter | ScanSegmenter | None]) -> None:
    """Require networks whose labels are of use, before a drive is labelled by them; what ``calibrate`` will
    have to be told is said.

    Raises:
        ConfigError: a network that knows no class that can be aligned.
    """
    for segmenter in segmenters:
        if segmenter is None or SemanticClass.VEHICLE in segmenter.known:
            continue
        known = [one.name.lower() for one in _OF_OBJECTS if one in segmenter.known]
        if not known:
            raise ConfigError(
                f"{segmenter.name}: found no class that can be aligned among its classes, "
                f"expected one of {', '.join(one.name.lower() for one in _OF_OBJECTS)}"
            )
        complain(f"note: {segmenter.name}: knows no vehicles: calibrate with --classes {','.join(known)}")


def store_to_fill(folder: Path | None) -> LabelStore:
    """The folder that labels are to be written to: new, empty, or one of labels, even if only begun; None:
    the user's cache.

    Raises:
        ConfigError: it holds something else, or is no folder.
    """
    from sst_graph.segmentation import LabelStore, cache_folder

    if folder is None:
        return LabelStore(cache_folder())
    store = LabelStore(folder)
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"{folder}: found a file, expected a folder or nothing")
    if folder.is_dir() and not (store.models("images") or store.models("scans") or store.is_begun()):
        raise ConfigError(f"{folder}: found a folder of other things, expected a new one or one of labels")
    return store


@cache
def image_segmenter(model: str | None) -> ImageSegmenter | None:
    """The network of ``--image-model``, loaded once for all drives."""
    from sst_graph.segmentation import open_image_segmenter

    return None if model is None else open_image_segmenter(model)


@cache
def scan_segmenter(model: str | None) -> ScanSegmenter | None:
    """The network of ``--lidar-model``, loaded once for all drives."""
    from sst_graph.segmentation import open_scan_segmenter

    return None if model is None else open_scan_segmenter(model)
