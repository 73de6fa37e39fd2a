"""How drives are read: as the command line says, and else as the result says that they were.

A calibration holds for the pairs of scans and images that it was made of. How they were read is kept in
calibration.json (``read_as``), so that a later command reads the same drive in the same way, or refuses it.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sst_graph.cli.labels import LABEL_OPTIONS, labelled
from sst_graph.cli.messages import complain
from sst_graph.cli.options import SOURCE_DEFAULTS
from sst_graph.data import open_source
from sst_graph.data.info.facts import facts_of
from sst_graph.data.rectified import lens_of
from sst_graph.data.source import source_options
from sst_graph.errors import ConfigError, DataError, SstGraphError
from sst_graph.files.typed_values import matches
from sst_graph.result import CalibrationResult, result_file
from sst_graph.types import Source

PAIRING = ("image_shift", "camera", "image_topic", "info_topic", "camera_file", "stamps", "lidar_pose")
"""Options without which a result means something else: they may not be contradicted."""

OF_A_TURN = ("sweep_start_deg", "sweep_stamp")
MEASUREMENT = ("cloud", "sweep", *OF_A_TURN, "cloud_topic", "mask_topic", "label_encoding", *LABEL_OPTIONS)
"""Options that change what is measured; another choice is allowed, and said."""

OF_ONE_DRIVE = ("sequence", "frames")
"""Options that belong to the drives of the result, not to any drive."""


def given_cameras(args: argparse.Namespace) -> list[str]:
    """Names after ``--camera``; what is a path there where DATA is not given is DATA.

    Raises:
        ConfigError: a camera is named twice, or DATA is missing.
    """
    names: list[str] = list(args.camera or ())
    while not args.data and names and os.path.exists(names[-1]):
        paths: list[Path] = []
        while names and os.path.exists(names[-1]):
            paths.insert(0, Path(names.pop()))
        args.data = paths
    if not args.data:
        help_ = f"see 'sst-graph {args.command} --help'"
        raise ConfigError(f"the following arguments are required: DATA ({help_})")
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise ConfigError(f"--camera {twice[0]}: found twice, expected each camera once")
    return names


def cameras_of_one_drive(args: argparse.Namespace) -> list[str | None]:
    """Names after ``--camera``, or None for that of the data, of a command that takes one DATA.

    Raises:
        ConfigError: as :func:`given_cameras`, or several DATA.
    """
    names = given_cameras(args)
    if len(args.data) > 1:
        raise ConfigError(f"{args.command}: found {len(args.data)} DATA, expected one")
    return [*names] or [None]


def options_of(args: argparse.Namespace) -> dict[str, Any]:
    """How the command line says that its drives are to be read, defaults filled in; also in ``args``."""
    given = {name: value for name in SOURCE_DEFAULTS if (value := getattr(args, name, None)) is not None}
    options = {**SOURCE_DEFAULTS, **given}
    for name, value in options.items():
        setattr(args, name, value)
    return options


def with_images_read(read_as: Mapping[str, Any], sources: Sequence[Source]) -> dict[str, Any]:
    """``read_as`` with the images' topic where none was named, and the lens from whose pictures they were
    rectified; each where it is that of all drives."""
    topics = {"" if (facts := facts_of(source)) is None else facts.image.topic for source in sources}
    lenses = {"" if (lens := lens_of(source)) is None else lens.name for source in sources}
    topic, lens_name = (names.pop() or None if len(names) == 1 else None for names in (topics, lenses))
    return {**read_as, "image_topic": read_as["image_topic"] or topic, "lens": lens_name}


def open_drive(args: argparse.Namespace, path: Path) -> Source:
    """The drive at ``path``, read as the command line says.

    Raises:
        ConfigError, DataError: an option or the data cannot be used.
    """
    return _checked_name(_opened(path, options_of(args)), path)


def open_drive_of(args: argparse.Namespace, path: Path, result: CalibrationResult, place: Path) -> Source:
    """The drive at ``path``, read as the drives of ``result`` (of the file ``place``) were.

    Options that are given win; what they change, and what was taken from the result, is said on stderr.

    Raises:
        ConfigError: an option contradicts the pairs that the result was made of; or as :func:`open_drive`.
    """
    stored = checked_options(result.read_as, place)
    _check_given(args, stored, place)
    options = dict(SOURCE_DEFAULTS)
    options |= {name: stored[name] for name in (*PAIRING, *MEASUREMENT) if name in stored}
    options |= {name: None for name in LABEL_OPTIONS if not _is_here(options[name])}
    if args.sweep not in (None, options["sweep"]):
        # Start and stamp of a turn go with the sweep that they were given with.
        options |= {name: SOURCE_DEFAULTS[name] for name in OF_A_TURN}
    options |= {name: getattr(args, name) for name in SOURCE_DEFAULTS if getattr(args, name) is not None}
    source, options = _opened_like(args, path, options, stored, {one.drive for one in result.frames_used})
    for name, value in options.items():
        if getattr(args, name) is None and value != SOURCE_DEFAULTS[name]:
            complain(f"note: read with {_flag(name)} {value}, as {place} was made")
        setattr(args, name, value)
    return _checked_name(source, path)


def warn_of_other_pairs(choice: str, options: Mapping[str, Any]) -> None:
    """Say so where a start comes from a result of other pairs of scans and images."""
    stored = _stored_in(result_file(Path(choice))).get("image_shift")
    if isinstance(stored, int) and stored != options["image_shift"]:
        complain(
            f"warning: {choice} was made with --image-shift {stored}, found --image-shift "
            f"{options['image_shift']}: its time offset is that of other pairs"
        )


def reading_words(read_as: Mapping[str, Any]) -> str:
    """The options that are not the default's, as on a command line; empty where there are none."""
    return " ".join(
        f"{_flag(name)} {shlex.quote(str(read_as[name]))}"
        for name, default in SOURCE_DEFAULTS.items()
        if name in read_as and read_as[name] != default
    )


def check_options(args: argparse.Namespace) -> None:
    """Refuse at once what no drive can be read with.

    Raises:
        ConfigError: an option out of range, or a file or folder that is not there.
    """
    options = options_of(argparse.Namespace(**vars(args)))
    source_options(**_of_drive(options))
    for name in LABEL_OPTIONS:
        if options[name] is not None and not _is_here(options[name]):
            raise ConfigError(f"{_flag(name)} {options[name]}: found no file or folder")


def _opened(path: Path, options: Mapping[str, Any]) -> Source:
    """The drive at a path, with labels by networks where the options ask for them."""
    return labelled(open_source(path, **_of_drive(options)), options)


def _of_drive(options: Mapping[str, Any]) -> dict[str, Any]:
    """Without those of labels."""
    return {name: value for name, value in options.items() if name not in LABEL_OPTIONS}


def _is_here(place: Any) -> bool:
    """Whether what a result was labelled by is still there; a name on a hub is left to the hub."""
    return isinstance(place, str) and (place.startswith("hf:") or os.path.exists(place))


def _opened_like(
    args: argparse.Namespace, path: Path, options: dict[str, Any], stored: Mapping[str, Any], drives: set[str]
) -> tuple[Source, dict[str, Any]]:
    """The drive; with the result's own sequence and frames if it is one of the result's drives."""
    own = {
        name: stored[name]
        for name in OF_ONE_DRIVE
        if getattr(args, name) is None and stored.get(name) is not None
    }
    if own:
        try:
            source = _opened(path, {**options, **own})
        except SstGraphError:
            source = None
        if source is not None and source.name in drives:
            return source, {**options, **own}
    return _opened(path, options), options


def _check_given(args: argparse.Namespace, stored: Mapping[str, Any], place: Path) -> None:
    for name in (*PAIRING, *MEASUREMENT):
        given = getattr(args, name)
        if given is None or name not in stored or given == stored[name]:
            continue
        if name in PAIRING:
            own = f"without {_flag(name)}" if stored[name] is None else f"with {_flag(name)} {stored[name]}"
            raise ConfigError(f"{_flag(name)} {given}: {place} was made {own}, expected the same")
        complain(f"warning: {place} was made with {_flag(name)} {stored[name]}, found {_flag(name)} {given}")


def _checked_name(source: Source, path: Path) -> Source:
    """The drive, if its name can stand in a file."""
    try:
        source.name.encode("utf-8")
    except UnicodeEncodeError:
        raise ConfigError(f"{path}: found a name that is not UTF-8, expected one that is") from None
    return source


def _stored_in(path: Path) -> Mapping[str, Any]:
    """``read_as`` of a calibration.json, empty for every other file."""
    if path.suffix != ".json" or not path.is_file():
        return {}
    try:
        stored = json.loads(path.read_bytes())["read_as"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {}  # whatever is wrong with it is said where it is read as a start
    return stored if isinstance(stored, dict) else {}


def checked_options(read_as: Mapping[str, Any], place: Path) -> dict[str, Any]:
    """The options of a result that are still known; those that are not of their kind are refused.

    Raises:
        DataError: a number in the place of a text, or the like.
    """
    stored = {name: value for name, value in read_as.items() if name in SOURCE_DEFAULTS}
    for name, value in stored.items():
        default = SOURCE_DEFAULTS[name]
        kind: Any = float | int if isinstance(default, float) else str if default is None else type(default)
        if not (matches(value, kind) or (value is None and default is None)):
            expected = "a text" if kind is str else "a number"
            raise DataError(f"{place}: read_as.{name}", f"{value!r:.60}", expected)
    return stored


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")
