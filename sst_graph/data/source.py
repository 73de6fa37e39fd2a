"""Opening a drive: the registry of loaders and the options they share."""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Literal, TypedDict, Unpack, get_args

import numpy as np
from numpy.typing import NDArray

from sst_graph.data.lidar_pose import LidarFrameSource, TimingFromCloud, parse_lidar_pose
from sst_graph.errors import ConfigError, DataError
from sst_graph.factors.arguments import described, is_whole
from sst_graph.files.reading import path_of
from sst_graph.files.typed_values import wrong_fields
from sst_graph.result import CALIBRATION_NAME, RIG_NAME, read_result
from sst_graph.sweep_timing import SweepStamp, SweepTiming
from sst_graph.types import Source
from sst_graph.validation import checked_source

Sweep = Literal["auto", "compensated", "clockwise", "counterclockwise", "instant", "azimuth"]
LabelEncoding = Literal["auto", "ids", "trainids", "coco", "coco-133", "ade20k", "ade20k-150", "mapillary"]
Stamps = Literal["header", "received"]

SWEEPS: tuple[Sweep, ...] = get_args(Sweep)
TURNS = {"clockwise": -1.0, "azimuth": -1.0, "counterclockwise": 1.0}
"""Share of the sweep in the points, as :class:`~sst_graph.sweep_timing.SweepTiming` counts it."""
AT_THE_STAMP = ("compensated", "instant")
"""Sweeps whose points are all taken for measured at the scan's stamp."""
STAMPS: tuple[Stamps, ...] = get_args(Stamps)
LABEL_ENCODINGS: tuple[LabelEncoding, ...] = get_args(LabelEncoding)

_CHOSEN = ("label_encoding", "sweep", "sweep_stamp", "stamps")
_EXPECTED = {"frames": "A:B, or a slice", "image_shift": "a whole number", "sweep_start_deg": "a number"}
"""What an option is, where it is no text."""
_LISTED = 5
"""Names in a folder that an error lists at most."""
_MOST_FRAMES = 2**62
"""Numbers of frames are below."""


@dataclass(frozen=True)
class SourceOptions:
    """How a drive is to be read; made by :func:`open_source`.

    Attributes:
        sequence: name of the sequence within the data set, or None for the only one.
        frames: frames to use, as a slice of their indices (step 1), or None for all. Where the sensors have
            stamps of their own, frames are counted in the order of stamps.
        image_shift: image k + image_shift gets the stamp of image k.
        camera: name of the camera, "image_2".
        cloud: name of the folder that holds the scans.
        label_encoding: how mask numbers are to be read; "auto" decides between the two of Cityscapes (ids,
            trainids) over several masks.
        sweep: "auto" uses the points' times where the data have them; where not, a calibration decides from
            the scans. "compensated" (or "instant"): all points share the stamp, stored times are ignored.
            "clockwise" (or "azimuth"), "counterclockwise": points as measured by a scanner that turns that
            way, seen from above; their times follow from their azimuths.
        sweep_start_deg: for these, the azimuth at which a turn begins, counter-clockwise from forward [deg].
        sweep_stamp: the instant that a scan's stamp names where times follow from azimuths, or are of another
            clock.
        image_topic, cloud_topic, info_topic: of a bag: topics of the camera, the LiDAR and the camera model,
            or None for the only ones there.
        camera_file: of a bag: the camera in a YAML file, in the place of a CameraInfo.
        mask_topic: of a bag: topic of semantic masks with the stamps of their images. With it the labels in
            the cloud are read, too. None: no labels.
        stamps: of a bag: "header" as the sensors' drivers stamp, or "received" by the recorder, for drivers
            that leave the header's stamp at zero.
        lidar_pose: T_cloud_lidar, "X,Y,Z" or "X,Y,Z,ROLL,PITCH,YAW" [m, deg], of clouds in other axes than
            the LiDAR's, such as the vehicle's. They are moved to the LiDAR's as they are read, and
            calibrations, the data's own included, are of these axes. None: they are in the LiDAR's axes.
    """

    sequence: str | None = None
    frames: slice | None = None
    image_shift: int = 0
    camera: str = "image_2"
    cloud: str = "velodyne"
    label_encoding: LabelEncoding = "auto"
    sweep: Sweep = "auto"
    sweep_start_deg: float = 180.0
    sweep_stamp: SweepStamp = "forward"
    image_topic: str | None = None
    cloud_topic: str | None = None
    info_topic: str | None = None
    camera_file: str | None = None
    mask_topic: str | None = None
    stamps: Stamps = "header"
    lidar_pose: str | None = None

    def __post_init__(self) -> None:
        for name in wrong_fields(self):
            if name not in _CHOSEN:
                found = f"{name.replace('_', ' ')} {getattr(self, name)!r:.60}"
                raise ConfigError(f"{found}: expected {_EXPECTED.get(name, 'a text')}")
        for name, value in vars(self).items():
            if isinstance(value, str) and "\0" in value:
                found = f"{name.replace('_', ' ')} {value!r:.60}"
                raise ConfigError(f"{found}: found a NUL character, expected none")
        if abs(self.image_shift) >= _MOST_FRAMES:
            raise ConfigError(f"image shift {described(self.image_shift)}: expected a number of frames")
        for what, choice, choices in (
            ("label encoding", self.label_encoding, LABEL_ENCODINGS),
            ("sweep", self.sweep, SWEEPS),
            ("sweep stamp", self.sweep_stamp, get_args(SweepStamp)),
            ("stamps", self.stamps, STAMPS),
        ):
            if not (isinstance(choice, str) and choice in choices):
                raise ConfigError(f"{what} {choice!r:.60}: expected one of {choices}")
        if not -360.0 <= self.sweep_start_deg <= 360.0:
            raise ConfigError(f"sweep start {self.sweep_start_deg} deg: expected -360 to 360")
        if self.sweep_start_deg != SourceOptions.sweep_start_deg and self.sweep not in TURNS:
            what = f"sweep start {self.sweep_start_deg} deg"
            raise ConfigError(
                f"{what}: found sweep {self.sweep}, expected clockwise or counterclockwise with it"
            )
        if self.sweep_stamp != SourceOptions.sweep_stamp and self.sweep in AT_THE_STAMP:
            raise ConfigError(
                f"sweep stamp {self.sweep_stamp}: found sweep {self.sweep}, whose points are all at the stamp"
            )
        if self.frames is not None:
            _check_frames(self.frames)
        if self.lidar_pose is not None:
            parse_lidar_pose(self.lidar_pose)

    def timing(self, stamps_ns: NDArray[np.int64]) -> SweepTiming | None:
        """Times of points by azimuth, where a sense of rotation is named; stamps_ns: (n,) of the scans.

        Raises:
            ConfigError: a single scan, which tells no period.
        """
        if self.sweep not in TURNS:
            return None
        if len(stamps_ns) < 2:
            raise ConfigError(f"sweep {self.sweep!r}: the period of a turn needs two scans or more")
        period_s = float(np.median(np.diff(stamps_ns))) * 1e-9
        start_rad = float(np.radians(self.sweep_start_deg))
        timing = SweepTiming(TURNS[self.sweep], start_rad, period_s, self.sweep_stamp)
        if self.lidar_pose is None:
            return timing
        return TimingFromCloud.of(timing, parse_lidar_pose(self.lidar_pose))


BAG_OPTIONS = ("image_topic", "cloud_topic", "info_topic", "camera_file", "mask_topic", "stamps")
"""Options that only bags have."""


@dataclass(frozen=True)
class Loader:
    """One data format.

    Attributes:
        recognizes: whether a path looks like this format.
        open: opens it.
        layout: what the format looks like on disk, for errors.
        unused: options (fields of :class:`SourceOptions`) that mean nothing here and are refused if given.
    """

    recognizes: Callable[[Path], bool]
    open: Callable[[Path, SourceOptions], Source]
    layout: str
    unused: tuple[str, ...] = BAG_OPTIONS

    def opened(self, path: Path, options: SourceOptions) -> Source:
        """The drive at ``path``.

        Raises:
            ConfigError, DataError: an option or the data cannot be used.
        """
        default = SourceOptions()
        for name in self.unused:
            if (value := getattr(options, name)) != getattr(default, name):
                raise ConfigError(
                    f"--{name.replace('_', '-')} {value}: means nothing for {path} ({self.layout})"
                )
        source = checked_source(self.open(path, options))
        if options.lidar_pose is None:
            return source
        return LidarFrameSource(source, parse_lidar_pose(options.lidar_pose))


ENTRY_POINTS = "sst_graph.loaders"
"""Group of the entry points by which packages add loaders; each names a :class:`Loader`."""

_LOADERS: dict[str, Loader] = {}


def register_loader(name: str, loader: Loader) -> None:
    """Make a format known to :func:`open_source` under ``name``.

    Raises:
        ConfigError: the name is taken, or reserved.
    """
    if name in _LOADERS or name == "auto":
        raise ConfigError(f"loader {name!r}: the name is taken")
    _LOADERS[name] = loader


def loader_names() -> tuple[str, ...]:
    """Names of the registered formats, then of those that installed packages add."""
    return (*_LOADERS, *_added())


def find_loader(name: str) -> Loader:
    """The format registered, or added by an installed package, under ``name``.

    Raises:
        ConfigError: there is none, or its package cannot be used.
    """
    if not isinstance(name, str):
        raise ConfigError(f"loader {name!r:.60}: expected the name of a format")
    if name in _LOADERS:
        return _LOADERS[name]
    entry = _added().get(name)
    if entry is None:
        raise ConfigError(f"loader {name!r}: expected one of auto, {', '.join(loader_names())}")
    try:
        loader = entry.load()
    except Exception as error:  # a package of others may fail in any way
        raise ConfigError(f"loader {name!r} of {entry.value}: {type(error).__name__}: {error}") from error
    if not isinstance(loader, Loader):
        raise ConfigError(
            f"loader {name!r} of {entry.value}: found a {type(loader).__name__}, expected a Loader"
        )
    return loader


def loader_behind(error: BaseException) -> tuple[str, str] | None:
    """Name of the loader of another package in whose code an exception was raised, or passed through, and the
    file and line there; None where it was in none."""
    modules = {entry.module: name for name, entry in _added().items()}
    modules |= {str(getattr(loader.open, "__module__", "")): name for name, loader in _LOADERS.items()}
    packages = {module.partition(".")[0]: name for module, name in modules.items()}
    packages.pop(__name__.partition(".")[0], None)
    found = None
    for frame, line in traceback.walk_tb(error.__traceback__):
        name = packages.get(str(frame.f_globals.get("__name__", "")).partition(".")[0])
        if name is not None:
            found = name, f"{os.path.basename(frame.f_code.co_filename)}:{line}"
    return found


def _added() -> dict[str, EntryPoint]:
    """Loaders of installed packages by name; the names of our own are not replaced."""
    found = {entry.name: entry for entry in entry_points(group=ENTRY_POINTS)}
    return {name: found[name] for name in sorted(found) if name not in _LOADERS and name != "auto"}


class ReadOptions(TypedDict, total=False):
    """The fields of :class:`SourceOptions` by keyword, besides ``frames``."""

    sequence: str | None
    image_shift: int
    camera: str
    cloud: str
    label_encoding: LabelEncoding
    sweep: Sweep
    sweep_start_deg: float
    sweep_stamp: SweepStamp
    image_topic: str | None
    cloud_topic: str | None
    info_topic: str | None
    camera_file: str | None
    mask_topic: str | None
    stamps: Stamps
    lidar_pose: str | None


def open_source(
    path: str | Path,
    *,
    loader: str = "auto",
    frames: str | slice | None = None,
    **options: Unpack[ReadOptions],
) -> Source:
    """Open a drive; each frame is read when it is accessed.

    Args:
        path: root of the data set, the folder of one sequence, or a bag.
        loader: a registered format, one that an installed package adds, or "auto" for the one that recognizes
            the path.
        frames: "A:B" (scan indices A..B-1; either may be left out) or a slice.
        options: the other fields of :class:`SourceOptions`.

    Raises:
        DataError: nothing there, or data that cannot be used.
        ConfigError: an option that is unknown or out of range.
    """
    chosen = source_options(loader, frames, **options)
    path = path_of(path, "a drive")
    if loader != "auto":
        return find_loader(loader).opened(path, chosen)
    try:
        present = path.exists()
    except OSError as error:  # such as a name that is too long
        raise DataError(path, f"no path ({error.strerror})", "a drive") from None
    if not present:
        raise DataError(path, "no file or folder", "a drive")
    found = recognized(path)
    if found is None and is_result(path):
        raise DataError(path, f"a result of sst-graph{_drives_of(path)}", "a drive")
    if found is None:
        layouts = [find_loader(name).layout for name in loader_names()]
        raise DataError(path, f"no layout that is known{_content(path)}", "; or ".join(layouts))
    return find_loader(found).opened(path, chosen)


def is_result(path: Path) -> bool:
    """Whether a path is that of a calibration, of one camera or of several: its folder or its file."""
    if path.is_dir():
        return any((path / name).is_file() for name in (CALIBRATION_NAME, RIG_NAME))
    return path.name in (CALIBRATION_NAME, RIG_NAME)


def _drives_of(path: Path) -> str:
    """The drives that a result was made of, in words; empty where its file does not say it."""
    try:
        names = dict.fromkeys(frame.drive for frame in read_result(path).frames_used)
    except DataError:
        return ""
    return f" (made of {', '.join(names)})" if names else ""


def _content(path: Path) -> str:
    """What a folder holds, in words; empty where it holds nothing or is a file."""
    names = sorted(entry.name for entry in path.iterdir()) if path.is_dir() else []
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return f" in a folder of {', '.join(names[:_LISTED])}{more}" if names else ""


def recognized(path: Path) -> str | None:
    """Name of the first format that a path looks like, or None."""
    return next((name for name in loader_names() if find_loader(name).recognizes(path)), None)


def source_options(
    loader: str = "auto", frames: str | slice | None = None, **options: Unpack[ReadOptions]
) -> SourceOptions:
    """Options of :func:`open_source`, whatever the drive.

    Raises:
        ConfigError: one that is unknown or out of range.
    """
    if not isinstance(loader, str):
        raise ConfigError(f"loader: found {described(loader)}, expected the name of a format")
    if loader != "auto":
        find_loader(loader)
    unknown = [name for name in options if name not in ReadOptions.__annotations__]
    if unknown:
        known = ", ".join(("loader", "frames", *ReadOptions.__annotations__))
        raise ConfigError(f"option {unknown[0]!r:.60}: expected one of {known}")
    return SourceOptions(frames=parse_frames(frames) if isinstance(frames, str) else frames, **options)


def parse_frames(text: str) -> slice:
    """Slice of a range "A:B", A and B counted from 0 and either left out at will.

    Raises:
        ConfigError: the text is no such range.
    """
    first, colon, last = (part.strip() for part in text.partition(":"))
    if not colon or not all(not part or (part.isdecimal() and len(part) < 20) for part in (first, last)):
        raise ConfigError(f"frames {text!r:.60}: expected A:B with numbers from 0, as in 10:50")
    return slice(int(first) if first else None, int(last) if last else None)


def _check_frames(frames: slice) -> None:
    for each in (frames.start, frames.stop, frames.step):
        if each is not None and not (is_whole(each) and abs(each) < _MOST_FRAMES):
            raise ConfigError(f"frames from or to {described(each)}: expected A:B with whole numbers from 0")
    first, last = frames.start or 0, frames.stop
    if frames.step not in (None, 1):
        raise ConfigError(f"frames with step {frames.step}: expected consecutive ones")
    if first < 0 or (last is not None and last <= first):
        raise ConfigError(f"frames {first}:{last}: expected A:B with 0 <= A < B")
