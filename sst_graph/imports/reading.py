"""Which format a file has, and the extrinsic and time offset in it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import gtsam

from sst_graph.data.kitti.calib import read_calibration
from sst_graph.data.ros.transforms import Transforms
from sst_graph.errors import ConfigError, DataError
from sst_graph.imports import chains, launch, records, tables, urdf
from sst_graph.imports.document import TREE, Document, read_document
from sst_graph.imports.frames import Found, ImportOptions, extrinsic_between, stated_time_offset_s
from sst_graph.marginal import FORMAT as MARGINAL_FORMAT
from sst_graph.result import file_of_one_camera
from sst_graph.types import ByValue

_DEFAULT_CAMERA = "image_2"
_RIG = "a rig of several cameras"
_KITTI_LINE = re.compile(r"^(P\d|Tr):\s", re.MULTILINE)
_PYTHON_LINE = re.compile(r"^[ \t]*(from|import) launch|^def generate_launch_description", re.MULTILINE)


@dataclass(frozen=True, eq=False)
class ImportedCalibration(ByValue):
    """What a file says of one camera and the LiDAR.

    Attributes:
        cTl: pose of the LiDAR in the camera's optical frame.
        time_offset_s: t_lidar = t_camera_stamp + time_offset_s, or None where the file does not say it.
        format: key of :data:`FORMATS`.
        taken: what was taken for what, in words.
    """

    cTl: gtsam.Pose3
    time_offset_s: float | None
    format: str
    taken: str

    def words(self) -> str:
        """Format, what was taken for what, and the time offset."""
        known = self.time_offset_s
        offset = "no time offset" if known is None else f"time offset {1e3 * known:+.3f} ms"
        return f"{self.format}, {self.taken}; {offset}"


def import_calibration(
    path: Path, options: ImportOptions | None = None, form: str | None = None
) -> ImportedCalibration:
    """The calibration in a file of any format of :data:`FORMATS`, or in the folder of a result.

    Args:
        form: the format; None recognizes it by the contents.

    Raises:
        DataError: missing or unreadable, no known format or several, no calibration of one camera.
        ConfigError: an unknown format, a camera whose name the format cannot have, or frames that change
            nothing in it.
        EstimationError: a marginal that leaves a direction open.
        MissingDependencyError: a YAML file, and PyYAML is not installed.
    """
    if form is not None and form not in FORMATS:
        raise ConfigError(f"format {form!r}: expected one of {', '.join(FORMATS)}")
    if path.is_dir() and (file := file_of_one_camera(path)).exists():
        path = file
    document = read_document(path)
    form = recognized(document, form)
    options = options or ImportOptions()
    options.check_effect(_FRAMES.get(form, ()), f"{path} is of the format {form}, which {_frames_of(form)}")
    return FORMATS[form](document, options, form)


def _frames_of(form: str) -> str:
    """What a format says of the options for frames."""
    known = ", ".join(f"--{name.replace('_', '-')}" for name in _FRAMES.get(form, ()))
    return f"has only {known}" if known else "names no frames"


def read_tree(path: Path) -> Transforms:
    """The transforms of a robot: URDF, xacro, a launch file, messages of tf, or a file of Autoware's.

    Raises:
        DataError: a file of another kind, or one without transforms.
        MissingDependencyError: a YAML file, and PyYAML is not installed.
    """
    document = read_document(path, TREE)
    expected = f"a tree of transforms: one of {', '.join(_TREES)}"
    if _is_rig(document):
        raise DataError(path, _RIG, expected)
    form = recognized(document)
    if form not in _TREES:
        raise DataError(path, f"a file of the format {form}", expected)
    return _TREES[form](document)


def recognized(document: Document, form: str | None = None) -> str:
    """The format of a text by its contents, a key of :data:`FORMATS`.

    Args:
        form: the one that it should be, where the contents go with several.

    Raises:
        DataError: none, several, or another one than ``form``.
        MissingDependencyError: as :func:`import_calibration`.
    """
    start = document.text.lstrip()[:1]
    if start == "<":
        found = _of_xml(document)
    elif start not in ("{", "[") and _KITTI_LINE.search(document.text):
        found = {"kitti"}
    else:
        found = _of_text(document, start)
    if form is not None and form in found:
        return form
    if not found:
        expected = f"one of {', '.join(FORMATS)}" if form is None else f"one of the format {form}"
        raise DataError(document.path, "a file of no known format", expected)
    if form is not None:
        raise DataError(document.path, f"a file of the format {sorted(found)[0]}", f"the format {form}")
    if len(found) > 1:
        expected = "keys of one format (import --from FORMAT chooses)"
        raise DataError(document.path, f"those of {' and of '.join(sorted(found))}", expected)
    return found.pop()


def _of_text(document: Document, start: str) -> set[str]:
    if start in ("{", "["):
        value = document.json
        if isinstance(value, dict):
            marginal = value.get("format") == MARGINAL_FORMAT
            if _is_rig(document):
                expected = "the calibration.json of one (calibrate --init takes the folder of a rig)"
                raise DataError(document.path, _RIG, expected)
            own = "T_camera_lidar" in value or value.get("format") == records.VEHICLE_FORMAT
            return {"gtsam"} if marginal else {"calibration"} if own else set()
        return {"nuscenes"} if records.is_nuscenes(value) else set()
    if document.path.suffix == ".py" or _PYTHON_LINE.search(document.text):
        return {"ros2-launch"}
    try:
        table = document.yaml
    except DataError:
        if document.path.suffix in (".yaml", ".yml"):
            raise
        return set()
    kinds = (("ros-tf", tables.is_message), ("autoware", tables.is_sensor_kit), ("opencv", records.is_opencv))
    return chains.dialects(table) | {name for name, matches in kinds if matches(table)}


def _is_rig(document: Document) -> bool:
    """Whether it is the result of a rig, a rig.json."""
    value = document.json if document.text.lstrip()[:1] == "{" else None
    return isinstance(value, dict) and value.get("format") == "sst-graph/rig"


def _of_xml(document: Document) -> set[str]:
    root = document.xml
    if root.tag == "robot":
        return {"xacro" if urdf.is_xacro(root) else "urdf"}
    if root.tag != "launch":
        return set()
    nodes = list(root.iter("node"))
    return {"ros2-launch-xml" if any("exec" in node.attrib for node in nodes) else "ros1-launch"}


def _kitti(document: Document, options: ImportOptions, form: str) -> ImportedCalibration:
    camera = options.camera or _DEFAULT_CAMERA
    cTl = read_calibration(document.path).cTl(camera)
    return ImportedCalibration(cTl, None, form, f"Tr, carried to {camera} by its line P")


_Reader = Callable[[Document, ImportOptions, str], ImportedCalibration]


def _by(read: Callable[[Document, ImportOptions], Found]) -> _Reader:
    """The reader of a format by one that knows what the poses of its format are."""

    def imported(document: Document, options: ImportOptions, form: str) -> ImportedCalibration:
        found = read(document, options)
        return ImportedCalibration(found.cTl, found.time_offset_s, form, found.taken)

    return imported


def _of_frames(document: Document, options: ImportOptions, form: str) -> ImportedCalibration:
    """The calibration in a format that holds named frames, and a time offset in a comment at best."""
    transforms = _TREES[form](document)
    tree = Transforms() if options.tree is None else options.tree.beside(transforms)
    cTl, camera, lidar = extrinsic_between(transforms.joined(tree), options, document.path)
    if tree.connected(camera, lidar):
        found = f"{camera!r} and {lidar!r} joined by --tree alone"
        raise DataError(document.path, found, "a transform of the file between them")
    time_offset_s = stated_time_offset_s(document.text, camera, document.path)
    return ImportedCalibration(cTl, time_offset_s, form, f"{lidar} in {camera}")


_TREES: dict[str, Callable[[Document], Transforms]] = {
    "ros-tf": tables.messages,
    "ros1-launch": launch.xml_publishers,
    "ros2-launch": launch.python_publishers,
    "ros2-launch-xml": launch.xml_publishers,
    "urdf": urdf.joints,
    "xacro": urdf.joints,
    "autoware": tables.sensor_kit,
}

_FRAMES: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(_TREES, ("camera_frame", "camera_link", "lidar_frame", "tree")),
    **dict.fromkeys(("kalibr", "openvins", "mins"), ("parent", "lidar_frame", "tree")),
    "nuscenes": ("lidar_frame",),
}
"""Options for frames that a format has a use for; formats that are not here name no frames."""

FORMATS: dict[str, _Reader] = {
    "calibration": _by(records.read_own),
    "kitti": _kitti,
    **dict.fromkeys(_TREES, _of_frames),
    "kalibr": _by(chains.read_chain),
    "openvins": _by(chains.read_chain),
    "mins": _by(chains.read_chain),
    "opencv": _by(records.read_opencv),
    "nuscenes": _by(records.read_nuscenes),
    "gtsam": _by(records.read_gtsam),
}
"""Readers by the name of the format."""
