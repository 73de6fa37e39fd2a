"""Opening a drive: the registry of loaders and the options they share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypedDict, Unpack, get_args

from sst_graph.errors import ConfigError, DataError
from sst_graph.sweep_timing import SweepStamp
from sst_graph.types import Source

Sweep = Literal["auto", "compensated", "clockwise", "counterclockwise", "instant", "azimuth"]
LabelEncoding = Literal["auto", "ids", "trainids"]

SWEEPS: tuple[Sweep, ...] = get_args(Sweep)
TURNS = {"clockwise": -1.0, "azimuth": -1.0, "counterclockwise": 1.0}
"""Share of the sweep in the points, as :class:`~sst_graph.sweep_timing.SweepTiming` counts it."""
LABEL_ENCODINGS: tuple[LabelEncoding, ...] = ("auto", "ids", "trainids")


@dataclass(frozen=True)
class SourceOptions:
    """How a drive is to be read; made by :func:`open_source`.

    Attributes:
        sequence: name of the sequence within the data set, or None for the only one.
        frames: frames to use, as a slice of their indices (step 1), or None for all. Where the sensors have
            stamps of their own, frames are counted in the order of stamps.
        image_shift: scan k is paired with image k + image_shift, stamped as if it were image k.
        camera: name of the camera, "image_2".
        cloud: name of the folder that holds the scans.
        label_encoding: how mask numbers are to be read; "auto" decides over several masks.
        sweep: "auto" uses the points' times where the data have them; where not, a calibration decides from
            the scans. "compensated" (or "instant"): all points share the stamp, stored times are ignored.
            "clockwise" (or "azimuth"), "counterclockwise": points as measured by a scanner that turns that
            way, seen from above; their times follow from their azimuths.
        sweep_start_deg: for these, the azimuth at which a turn begins, counter-clockwise from forward [deg].
        sweep_stamp: the instant that a scan's stamp names where times follow from azimuths.
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

    def __post_init__(self) -> None:
        if self.label_encoding not in LABEL_ENCODINGS:
            raise ConfigError(f"label encoding {self.label_encoding!r}: expected one of {LABEL_ENCODINGS}")
        if self.sweep not in SWEEPS:
            raise ConfigError(f"sweep {self.sweep!r}: expected one of {SWEEPS}")
        if self.sweep_stamp not in get_args(SweepStamp):
            raise ConfigError(f"sweep stamp {self.sweep_stamp!r}: expected one of {get_args(SweepStamp)}")
        if not -360.0 <= self.sweep_start_deg <= 360.0:
            raise ConfigError(f"sweep start {self.sweep_start_deg} deg: expected -360 to 360")
        if self.frames is not None:
            _check_frames(self.frames)


@dataclass(frozen=True)
class Loader:
    """One data format.

    Attributes:
        recognizes: whether a path looks like this format.
        open: opens it.
        layout: what the format looks like on disk, for errors.
    """

    recognizes: Callable[[Path], bool]
    open: Callable[[Path, SourceOptions], Source]
    layout: str


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
    """Names of the registered formats."""
    return tuple(_LOADERS)


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


def open_source(
    path: str | Path,
    *,
    loader: str = "auto",
    frames: str | slice | None = None,
    **options: Unpack[ReadOptions],
) -> Source:
    """Open a drive; frames are read when asked for.

    Args:
        path: root of the data set, or the folder of one sequence.
        loader: a registered format, or "auto" for the one that recognizes the path.
        frames: "A:B" (scan indices A..B-1; either may be left out) or a slice.
        options: the other fields of :class:`SourceOptions`.

    Raises:
        DataError: nothing there, or data that cannot be used.
        ConfigError: an option that is unknown or out of range.
    """
    chosen = SourceOptions(frames=parse_frames(frames) if isinstance(frames, str) else frames, **options)
    path = Path(path)
    if loader != "auto":
        if loader not in _LOADERS:
            raise ConfigError(f"loader {loader!r}: expected one of auto, {', '.join(_LOADERS)}")
        return _LOADERS[loader].open(path, chosen)
    if not path.is_dir():
        raise DataError(path, "no folder" if not path.exists() else "a file", "the folder of a drive")
    for candidate in _LOADERS.values():
        if candidate.recognizes(path):
            return candidate.open(path, chosen)
    raise DataError(path, "no layout that is known", "; or ".join(c.layout for c in _LOADERS.values()))


def parse_frames(text: str) -> slice:
    """Slice of a range "A:B", A and B counted from 0 and either left out at will.

    Raises:
        ConfigError: the text is no such range.
    """
    first, colon, last = text.partition(":")
    if not colon or not all(part.strip().isdecimal() or not part.strip() for part in (first, last)):
        raise ConfigError(f"frames {text!r}: expected A:B with numbers from 0, as in 10:50")
    return slice(int(first) if first.strip() else None, int(last) if last.strip() else None)


def _check_frames(frames: slice) -> None:
    first, last = frames.start or 0, frames.stop
    if frames.step not in (None, 1):
        raise ConfigError(f"frames with step {frames.step}: expected consecutive ones")
    if first < 0 or (last is not None and last <= first):
        raise ConfigError(f"frames {first}:{last}: expected A:B with 0 <= A < B")
