"""The options of every command. Imports nothing heavy: ``--help`` answers at once."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import sst_graph
from sst_graph.cli.messages import complain, say
from sst_graph.errors import ConfigError

if TYPE_CHECKING:
    from _typeshed import SupportsWrite

SIGN = "t_lidar = t_camera_stamp + offset"


class _Parser(argparse.ArgumentParser):
    """An argument parser that complains through :class:`ConfigError`."""

    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message} (see '{self.prog} --help')")

    def _print_message(self, message: str, file: SupportsWrite[str] | None = None) -> None:
        # Help and version are printed nowhere else; argparse's own passes over a stdout that fails.
        say(message, end="")


class _Renamed(argparse.Action):
    """A switch under its former name: sets what the switch ``const`` sets, and says so."""

    def __init__(self, option_strings: Sequence[str], dest: str, const: str, help: str | None = None) -> None:
        super().__init__(option_strings, const.lstrip("-").replace("-", "_"), nargs=0, const=const, help=help)

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        setattr(namespace, self.dest, True)
        complain(f"{option_string} is now called {self.const}")


def build_parser() -> argparse.ArgumentParser:
    """The parser of ``sst-graph`` with all its commands."""
    parser = _Parser(
        prog="sst-graph",
        description="LiDAR-camera calibration without targets, in space and time, as a GTSAM factor graph.",
        epilog="Exit codes: 0 done; 2 bad input or usage, or an output that could not be written; 3 "
        "finished, but the result is not to be trusted (the reason is on stderr, the files are written); "
        "130, 143, 129 ended by Ctrl-C, SIGTERM, SIGHUP; 141 the reader of stdout has gone.",
    )
    parser.add_argument("--version", action="version", version=f"sst-graph {sst_graph.__version__}")
    commands = parser.add_subparsers(
        dest="command", metavar="COMMAND", required=True, parser_class=_Parser, title="commands"
    )
    for add in (
        _add_demo,
        _add_simulate,
        _add_calibrate,
        _add_batch,
        _add_track,
        _add_evaluate,
        _add_inspect,
        _add_overlay,
        _add_view,
        _add_export,
        _add_import,
        _add_info,
        _add_segment,
        _add_settings_command,
        _add_experiment,
        _add_completion,
    ):
        command = add(commands)
        loudness = command.add_mutually_exclusive_group()
        loudness.add_argument("-v", "--verbose", action="store_true", help="log what happens on stderr")
        loudness.add_argument(
            "-q",
            "--quiet",
            action="store_true",
            help="no progress, and no summary of what stands in the files; warnings and errors only",
        )
    return parser


def _add_demo(commands: argparse._SubParsersAction[_Parser]) -> argparse.ArgumentParser:
    text = "simulate a street, calibrate it from disk, check against the truth, write report and overlays"
    demo = commands.add_parser("demo", help=text, description=text)
    demo.add_argument(
        "--out",
        type=Path,
        default=Path("out/demo"),
        metavar="DIR",
        help="folder to write (default %(default)s)",
    )
    demo.add_argument("--seed", type=int, default=1, help="seed of the street (default %(default)s)")
    demo.add_argument("--overwrite", action="store_true", help="replace an earlier demo in that folder")
    return demo


def _add_simulate(commands: argparse._SubParsersAction[_Parser]) -> argparse.ArgumentParser:
    text = "write a simulated drive in the KITTI odometry + SemanticKITTI layout, with its truth"
    simulate = commands.add_parser("simulate", help=text, description=text)
    simulate.add_argument("out", metavar="OUT", type=Path, help="folder to write")
    simulate.add_argument("--seed", type=int, help="seed of the street and of all noise")
    simulate.add_argument("--frames", type=int, metavar="N", help="number of frames")
    simulate.add_argument(
        "--time-offset", type=float, metavar="S", help=f"true time offset in seconds, of either sign: {SIGN}"
    )
    simulate.add_argument("--delay", dest="time_offset", type=float, help=argparse.SUPPRESS)
    motions = "mixed, standing, constant, stop_and_go, no_stop, turning, there_and_back"
    simulate.add_argument("--motion", metavar="NAME", help=motions)
    simulate.add_argument("--label-noise", type=float, metavar="LEVEL", help="0: exact, 1: usual, 2: poor")
    simulate.add_argument(
        "--rolling", action="store_true", default=None, help="measure each point at its own time"
    )
    simulate.add_argument(
        "--stereo", action="store_true", help="write image_3 and semantic_3 as well, 0.53 m to the right"
    )
    _add_settings(simulate)
    simulate.add_argument("--overwrite", action="store_true", help="replace an earlier drive in OUT")
    return simulate


def _add_calibrate(commands: argparse._SubParsersAction[_Parser]) -> argparse.ArgumentParser:
    text = "estimate T_camera_lidar and the time offset of one or several drives"
    calibrate = commands.add_parser(
        "calibrate",
        help=text,
        description=f"{text[0].upper()}{text[1:]}: p_camera = T_camera_lidar . p_lidar (camera: x right, "
        f"y down, z forward), {SIGN}. Several drives share one extrinsic.",
    )
    calibrate.add_argument(
        "data", metavar="DATA", type=Path, nargs="*", help="dataset or sequence folder, or a bag"
    )
    _add_source_options(calibrate, several_cameras=True)
    _add_label_options(calibrate)
    _add_method(calibrate)
    calibrate.add_argument(
        "--time-offset-per-drive", action="store_true", default=None, help="one time offset for each drive"
    )
    calibrate.add_argument(
        "--delay-per-drive", action=_Renamed, const="--time-offset-per-drive", help=argparse.SUPPRESS
    )
    _add_rig(calibrate)
    calibrate.add_argument(
        "--out",
        type=Path,
        default=Path("calibration"),
        metavar="DIR",
        help="folder to write (default %(default)s)",
    )
    calibrate.add_argument(
        "--video", type=Path, metavar="MP4|GIF", help="write the LiDAR in the pictures along the drives, too"
    )
    calibrate.add_argument(
        "--json", action="store_true", help="print the result as JSON (units in the names), not a summary"
    )
    calibrate.add_argument(
        "--overwrite", action="store_true", help="replace an earlier result in DIR, and the video"
    )
    return calibrate


def _add_method(command: _Parser) -> None:
    """How one drive or several are calibrated."""
    command.add_argument(
        "--method",
        choices=("auto", "joint", "edges", "both", "motion", "paper", "static", "semalign"),
        help="auto: joint where both sensors have labels, both where one of several drives has none, else "
        "edges (default); joint: extrinsic and offset by outlines of labelled objects; edges: the same by "
        "LiDAR edges and pictures, no labels needed; both: joint in frames with labels, edges in the others; "
        "motion: LiDAR odometry against visual odometry, no labels needed; paper: SST-Calib as printed; "
        "static: its first stage, the extrinsic alone; semalign: sampled starts, the extrinsic alone",
    )
    command.add_argument(
        "--init",
        metavar="dataset|none|FILE",
        default="dataset",
        help="start: the data's nominal calibration (default), no guess at all, or a calibration.json or "
        "another file that import reads (KITTI, ROS, Kalibr, ...)",
    )
    command.add_argument(
        "--classes", metavar="vehicle|all|A,B", help="classes to align, such as vehicle,pole"
    )
    _add_estimate(command)
    _add_settings(command)
    command.add_argument(
        "--no-report", action="store_true", help="leave out report.html, the page with pictures and charts"
    )


def _add_rig(command: _Parser) -> None:
    """What is known of several cameras."""
    rig = command.add_argument_group("several cameras (docs/how-to/rigs.md)")
    rig.add_argument(
        "--rig",
        metavar="dataset|FILE",
        help="known poses between the cameras: those of the data's nominal calibration, or of Kalibr's "
        "camchain.yaml (T_cn_cnm1) or KITTI's calib.txt",
    )
    rig.add_argument(
        "--rig-sigma",
        metavar="DEG,CM",
        help="how well these are known, one sigma along each axis (default 0.03,0.2)",
    )
    rig.add_argument(
        "--one-trigger", action="store_true", help="all cameras are triggered together: one time offset"
    )


def _add_estimate(command: _Parser) -> None:
    command.add_argument(
        "--estimate",
        metavar="NAMES",
        help="estimate what is otherwise assumed, with the calibration: some of focal, cx, cy, k1, "
        "k2, sweep, skew, line_delay, range_bias, range_scale, elevation, separated by commas; k1=0.05 gives "
        "the standard deviation of its prior about 0 (docs/understand/assumptions.md)",
    )


def _add_batch(commands: argparse._SubParsersAction[_Parser]) -> argparse.ArgumentParser:
    text = "calibrate many drives, each in a process of its own; fuse those of one vehicle; one summary"
    batch = commands.add_parser(
        "batch",
        help=text,
        description=f"{text[0].upper()}{text[1:]} (docs/how-to/batch.md). "
        "Drives that are done are not run again.",
    )
    batch.add_argument(
        "drives",
        metavar="DRIVES",
        help="folder of drives, pattern such as 'drives/*' (in quotes), or list: one path or URL a line, or "
        "a CSV with a column drive and any of name, vehicle, date",
    )
    batch.add_argument(
        "--out", required=True, metavar="DIR", help="folder to write or to go on with, or a URL"
    )
    batch.add_argument(
        "--workers", type=int, metavar="N", help="drives at a time on this machine (default: its processors)"
    )
    batch.add_argument(
        "--dask",
        default="",
        metavar="ADDRESS|local",
        help="run on a Dask cluster: its scheduler, such as tcp://host:8786, or local (extra dask)",
    )
    batch.add_argument(
        "--retries",
        type=int,
        default=2,
        metavar="N",
        help="further attempts after a crash (default %(default)s)",
    )
    batch.add_argument("--time-limit", type=float, metavar="S", help="longest time of a drive in seconds")
    batch.add_argument("--memory-limit", type=float, metavar="GB", help="largest memory of a drive")
    batch.add_argument(
        "--name-parts",
        type=int,
        default=1,
        metavar="N",
        help="how many of the last parts of its path make a drive's name (default %(default)s)",
    )
    vehicles = batch.add_argument_group("vehicles")
    vehicles.add_argument(
        "--vehicle-from",
        metavar="REGEX|CSV",
        help="vehicle and date of a drive: a regular expression on its path with the groups vehicle and "
        "date, or a CSV with columns drive, vehicle and date",
    )
    vehicles.add_argument(
        "--drift",
        metavar="DEG,CM,MS",
        help="random walk of a vehicle's calibration: standard deviation along each axis after one day "
        "(default 0.005,0.05,0.1)",
    )
    vehicles.add_argument(
        "--false-alarm-rate",
        type=float,
        metavar="P",
        help="probability that a change or a contradicting drive is named of a vehicle without any "
        "(default 0.001)",
    )
    own = len(batch._actions)
    _add_source_options(batch)
    _add_label_options(batch)
    _add_method(batch)
    batch.set_defaults(passed_on=tuple(batch._actions[own:]), time_offset_per_drive=None)
    return batch


def _add_track(commands: argparse._SubParsersAction[_Parser]) -> argparse.ArgumentParser:
    text = "calibrate frame by frame: one line of JSON a frame on stdout"
    track = commands.add_parser("track", help=text, description=text)
    track.add_argument("data", metavar="DATA", type=Path, help="dataset or sequence folder, or a bag")
    _add_source_options(track)
    _add_label_options(track)
    track.add_argument(
        "--init",
        metavar="dataset|none|FILE",
        help="start: the data's nominal calibration (default), no guess at all, or a file",
    )
    track.add_argument("--classes", metavar="vehicle|all|A,B", help="classes to align")
    _add_estimate(track)
    _add_settings(track)
    track.add_argument("--checkpoint", type=Path, metavar="FILE", help="save the tracker here as it goes")
    track.add_argument(
        "--checkpoint-every", type=int, default=50, metavar="N", help="frames between saves (default 50)"
    )
    track.add_argument(
        "--resume",
        action="store_true",
        help="go on from the checkpoint, if it is there, with the frames after it; the drive must be the one "
        "it was saved on, and options that are given those it was made with",
    )
    track.add_argument("--out", type=Path, metavar="FILE", help="write the last estimate as calibration.json")
    track.add_argument("--view", action="store_true", help="show the tracker in the viewer rerun as it runs")
    track.add_argument("--view-save", type=Path, metavar="RRD", help="write a file for that viewer")
    track.add_argument("--overwrite", action="store_true", help="replace the files that are written")
    return track


def _add_evaluate(commands: argparse._SubParsersAction[_Parser]) -> argparse.ArgumentParser:
    text = "compare a result with the truth: QAD, AEAD [deg], ATD [cm], time error [ms], NEES"
    evaluate = commands.add_parser("evaluate", help=text, description=text)
    evaluate.add_argument("result", metavar="RESULT", type=Path, help="calibration.json, or its folder")
    evaluate.add_argument(
        "--truth",
        metavar="FILE",
        type=Path,
        required=True,
        help="groundtruth.json, calibration.json, or a KITTI calib.txt (then without time offset)",
    )
    evaluate.add_argument(
        "--truth-sigma",
        metavar="ROT_DEG,TRANS_CM,MS",
        help="how well the truth is known itself, one sigma along each axis; the NEES counts it in "
        "(0.1,1,2 for KITTI's published calibration)",
    )
    evaluate.add_argument("--json", action="store_true", help="print JSON (degrees, metres, seconds)")
    return evaluate


def _add_inspect(commands: argparse._SubParsersAction[_Parser]) -> argparse.ArgumentParser:
    text = "how far a result can be trusted: sigmas, correlations, weak directions, what to record next"
    inspect = commands.add_parser(
        "inspect",
        help=text,
        description=f"{text[0].upper()}{text[1:]}; docs/how-to/inspect.md explains each line.",
    )
    inspect.add_argument("result", metavar="RESULT", type=Path, help="calibration.json, or its folder")
    inspect.add_argument("--all-frames", action="store_true", help="every frame in the table")
    inspect.add_argument(
        "--next", type=int, default=10, metavar="N", help="frames to record next (default %(default)s)"
    )
    inspect.add_argument("--json", action="store_true", help="print JSON (units in the names)")
    inspect.add_argument(
        "--plots", type=Path, metavar="DIR", help="folder for plots as PNG (needs matplotlib)"
    )
    inspect.add_argument("--overwrite", action="store_true", help="replace earlier plots in DIR")
    return inspect


def _add_overlay(commands: argparse._SubParsersAction[_Parser]) -> argparse.ArgumentParser:
    text = "draw the LiDAR into the camera image, before and after a calibration"
    overlay = commands.add_parser("overlay", help=text, description=text)
    overlay.add_argument("result", metavar="RESULT", type=Path, help="calibration.json, or its folder")
    overlay.add_argument("data", metavar="DATA", type=Path, help="drive: dataset or sequence folder")
    _add_source_options(overlay)
    _add_label_options(overlay)
    overlay.add_argument(
        "--frame", type=int, metavar="K", help="index of the frame to draw (default: the middle one)"
    )
    overlay.add_argument(
        "--before",
        metavar="initial|dataset|FILE",
        default="initial",
        help="what to compare with: the result's own start (default), the data's nominal, or a file",
    )
    written = overlay.add_mutually_exclusive_group()
    written.add_argument(
        "--out", type=Path, metavar="PNG", help="picture of one frame to write (default overlay.png)"
    )
    written.add_argument(
        "--video", type=Path, metavar="MP4|GIF", help="video of all frames to write, instead of a picture"
    )
    overlay.add_argument("--overwrite", action="store_true", help="replace the picture or the video")
    return overlay


EXPORTS = (
    "kitti",
    "ros-tf",
    "ros1-launch",
    "ros2-launch",
    "ros2-launch-xml",
    "urdf",
    "xacro",
    "autoware",
    "kalibr",
    "openvins",
    "mins",
    "opencv",
    "nuscenes",
    "gtsam",
)
"""Formats of ``sst_graph.export``, which is not imported for the help's sake; a test compares them."""


def _add_view(commands: argparse._SubParsersAction[_Parser]) -> argparse.ArgumentParser:
    text = "show a result in the viewer rerun: clouds, pictures, matches, trajectory, tracks, sigmas"
    view = commands.add_parser("view", help=text, description=text)
    view.add_argument("result", metavar="RESULT", type=Path, help="calibration.json, or its folder")
    view.add_argument("data", metavar="DATA", type=Path, help="drive: dataset or sequence folder, or a bag")
    _add_source_options(view)
    _add_label_options(view)
    view.add_argument(
        "--save", type=Path, metavar="RRD", help="write a file for the viewer, instead of opening it"
    )
    view.add_argument("--overwrite", action="store_true", help="replace the file")
    return view


def _add_export(commands: argparse._SubParsersAction[_Parser]) -> argparse.ArgumentParser:
    text = "write a result in the format of another program"
    export = commands.add_parser(
        "export",
        help=text,
        description=f"{text[0].upper()}{text[1:]}; docs/how-to/export.md states frames and signs.",
    )
    export.add_argument(
        "result", metavar="RESULT", type=Path, help="calibration.json, rig.json, or the folder of one"
    )
    export.add_argument(
        "--to",
        required=True,
        choices=EXPORTS,
        help="format; gtsam: the marginal on (E, D) as JSON with a serialized LinearContainerFactor",
    )
    export.add_argument("--out", type=Path, metavar="FILE", help="file to write (default: stdout)")
    export.add_argument("--overwrite", action="store_true", help="replace the file")
    export.add_argument(
        "--force", action="store_true", help="export a result whose status is not ok, with a warning"
    )
    export.add_argument(
        "--calib",
        type=Path,
        metavar="FILE",
        help="kitti only: calib.txt whose P lines place the camera beside camera 0 "
        "(without it the camera counts as camera 0)",
    )
    frames = export.add_argument_group("frames (docs/how-to/export.md)")
    frames.add_argument(
        "--camera-frame",
        metavar="NAME",
        help="the camera's optical frame, z forward (default camera_optical_frame; of a rig "
        "{camera}_optical_frame, with the camera's name for {camera})",
    )
    frames.add_argument(
        "--camera-link",
        metavar="NAME",
        help="the camera's link, x forward (default: the optical frame's name with _link for _optical_frame)",
    )
    frames.add_argument(
        "--lidar-frame", default="lidar", metavar="NAME", help="the LiDAR's frame (default %(default)s)"
    )
    frames.add_argument(
        "--parent",
        metavar="FRAME",
        help="write the pose of the child in this frame: the LiDAR's, the camera's (default), or one of "
        "--tree; the kit (autoware), the ego frame (nuscenes), the IMU (kalibr, openvins, mins)",
    )
    frames.add_argument(
        "--child", metavar="FRAME", help="the other end: a frame of the camera, or one of the LiDAR's side"
    )
    frames.add_argument(
        "--tree",
        type=Path,
        metavar="FILE",
        help="the vehicle's transforms, with the LiDAR's frame: URDF, a launch file, tf messages as YAML, "
        "Autoware's sensor kit",
    )
    return export


IMPORTS = ("calibration", *EXPORTS)
"""Formats of ``sst_graph.imports``; a test compares them."""


def _add_import(commands: argparse._SubParsersAction[_Parser]) -> argparse.ArgumentParser:
    text = "turn a calibration of another program into a start for --init"
    command = commands.add_parser(
        "import",
        help=text,
        description=f"{text[0].upper()}{text[1:]}; docs/how-to/imports.md states what is taken for what. "
        "--init FILE reads the same files where nothing has to be named.",
    )
    command.add_argument("file", metavar="FILE", type=Path, help="file in a format that export writes")
    command.add_argument(
        "--from", dest="form", choices=IMPORTS, help="format (default: recognized by the contents)"
    )
    command.add_argument("--camera", metavar="NAME", help="the camera, of a file with several")
    frames = command.add_argument_group("frames")
    frames.add_argument(
        "--camera-frame", metavar="NAME", help="the camera's optical frame: x right, y down, z forward"
    )
    frames.add_argument(
        "--camera-link", metavar="NAME", help="instead, the camera's link: x forward, y left, z up"
    )
    frames.add_argument("--lidar-frame", metavar="NAME", help="the LiDAR's frame")
    frames.add_argument(
        "--parent",
        metavar="FRAME",
        help="kalibr, openvins: frame in the IMU's place (default: the LiDAR itself)",
    )
    frames.add_argument(
        "--tree",
        type=Path,
        metavar="FILE",
        help="further transforms, such as that from --parent to the LiDAR",
    )
    command.add_argument("--out", type=Path, metavar="FILE", help="file to write (default: stdout)")
    command.add_argument("--overwrite", action="store_true", help="replace the file")
    return command


def _add_info(commands: argparse._SubParsersAction[_Parser]) -> argparse.ArgumentParser:
    text = "what a drive holds: sensors, rates, stamps, gaps, labels, and what is missing for which method"
    info = commands.add_parser("info", help=text, description=text)
    info.add_argument("data", metavar="DATA", type=Path, help="dataset or sequence folder, or a bag")
    _add_source_options(info)
    _add_label_options(info)
    info.add_argument("--json", action="store_true", help="print JSON (units in the names)")
    return info


def _add_segment(commands: argparse._SubParsersAction[_Parser]) -> argparse.ArgumentParser:
    text = "label a drive by networks ahead of its calibration, and keep the labels"
    segment = commands.add_parser(
        "segment",
        help=text,
        description=f"{text[0].upper()}{text[1:]}; docs/how-to/networks.md has examples.",
    )
    segment.add_argument("data", metavar="DATA", type=Path, help="dataset or sequence folder, or a bag")
    _add_source_options(segment)
    _add_networks(segment.add_argument_group("networks (docs/how-to/networks.md)"))
    segment.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder of labels, for --labels DIR; what it has is not made again (default: the user's cache, "
        "where the other commands look for the labels of their networks)",
    )
    return segment


def _add_settings_command(commands: argparse._SubParsersAction[_Parser]) -> argparse.ArgumentParser:
    text = "list the settings of calibrate and track: default, unit, range, and when to change them"
    settings = commands.add_parser("settings", help=text, description=text)
    settings.add_argument(
        "name",
        metavar="NAME",
        nargs="?",
        default="",
        help="only those whose dotted name contains this, such as start or joint.graph",
    )
    form = settings.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help="print JSON")
    form.add_argument("--markdown", action="store_true", help="print Markdown (docs/reference/settings.md)")
    return settings


def _add_experiment(commands: argparse._SubParsersAction[_Parser]) -> argparse.ArgumentParser:
    text = "make a table of accuracy, as Markdown: on simulated streets, or on real drives"
    experiment = commands.add_parser("experiment", help=text, description=text)
    experiment.add_argument(
        "name",
        metavar="NAME",
        help="accuracy, assumptions, basin, consistency, drives, fit, motion, peers, rigs, slam, windows, or "
        "a table of SST-Calib: table1, table2, table3, table4; any other name prints what each of them "
        "shows; drives and windows need --data",
    )
    experiment.add_argument(
        "--data",
        nargs="+",
        metavar="DIR",
        help="real drives with a reference calibration, or a KITTI odometry root, of which table1 to table4 "
        "take sequence 00 (default: simulated streets)",
    )
    experiment.add_argument("--streets", type=int, metavar="N", help="number of streets")
    experiment.add_argument("--seed", type=int, help="seed of the first street")
    experiment.add_argument("--methods", metavar="A,B", help="methods to compare, such as paper,joint")
    experiment.add_argument(
        "--jobs", type=int, metavar="N", help="basin, peers, table1 to table4: processes (default: 1)"
    )
    _add_settings(experiment)
    experiment.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="file to write (default: the terminal); table1 to table4 put a CSV, a plot and the runs beside "
        "it, and go on from those runs",
    )
    experiment.add_argument("--overwrite", action="store_true", help="replace the files")
    return experiment


def _add_completion(commands: argparse._SubParsersAction[_Parser]) -> argparse.ArgumentParser:
    text = "print what completes commands and options in a shell"
    completion = commands.add_parser(
        "completion",
        help=text,
        description=f"{text[0].upper()}{text[1:]}: source <(sst-graph completion bash), or in zsh "
        "sst-graph completion zsh > a folder of $fpath, as _sst-graph.",
    )
    completion.add_argument("shell", choices=("bash", "zsh", "tcsh"))
    return completion


SOURCE_DEFAULTS: dict[str, str | int | float | None] = {
    "loader": "auto",
    "sequence": None,
    "frames": None,
    "camera": "image_2",
    "cloud": "velodyne",
    "image_shift": 0,
    "sweep": "auto",
    "sweep_start_deg": 180.0,
    "sweep_stamp": "forward",
    "image_topic": None,
    "cloud_topic": None,
    "info_topic": None,
    "mask_topic": None,
    "stamps": "header",
    "label_encoding": "auto",
    "image_model": None,
    "lidar_model": None,
    "labels": None,
}
"""How a drive is read where neither the command line nor a result says it. The parser leaves these options
None where they are not given: :mod:`sst_graph.cli.reading` fills them in."""


def _add_source_options(command: argparse.ArgumentParser, several_cameras: bool = False) -> None:
    """How a drive is read."""
    source = command.add_argument_group("data")
    source.add_argument(
        "--loader",
        help="format: auto (default), kitti, kitti-raw, folder, nuscenes, ros, or an installed one",
    )
    source.add_argument("--sequence", metavar="NN", help="sequence of a dataset folder, such as 00")
    source.add_argument("--frames", metavar="A:B", help="frames A to B-1 only")
    named = f"camera folder, nuScenes channel or image topic (default {SOURCE_DEFAULTS['camera']})"
    if several_cameras:
        source.add_argument("--camera", nargs="+", metavar="NAME", help=f"{named}; several: a rig")
    else:
        source.add_argument("--camera", metavar="NAME", help=named)
    source.add_argument("--cloud", help=f"folder of the scans (default {SOURCE_DEFAULTS['cloud']})")
    source.add_argument(
        "--image-shift",
        type=int,
        metavar="N",
        help="pair scan k with image k+N, stamped as if it were image k: an offset of N frame times",
    )
    source.add_argument(
        "--label-encoding",
        choices=("auto", "ids", "trainids", "coco", "coco-133", "ade20k", "ade20k-150", "mapillary"),
        help="numbers of stored masks: Cityscapes ids or trainids (auto: the one that fits), or those of "
        "another data set",
    )
    source.add_argument(
        "--sweep",
        choices=("auto", "compensated", "clockwise", "counterclockwise", "instant", "azimuth"),
        help="times of the points: stored ones where there are, else what the scans show (auto, default); "
        "all at the stamp (compensated, or instant); as measured by a scanner that turns, seen from above, "
        "clockwise (or azimuth) or counterclockwise",
    )
    source.add_argument(
        "--sweep-start-deg",
        type=float,
        metavar="DEG",
        help="with --sweep clockwise or counterclockwise: azimuth at which a turn begins, counter-clockwise "
        "from forward (default 180: behind)",
    )
    source.add_argument(
        "--sweep-stamp",
        choices=("forward", "start", "end"),
        help="instant of a turn that a scan's stamp names, where times follow from azimuths: the laser faces "
        "forward (default), the turn begins or ends; no data separate it from a time offset",
    )
    bag = command.add_argument_group("bags (docs/how-to/ros.md)")
    bag.add_argument(
        "--image-topic", metavar="TOPIC", help="Image or CompressedImage, where there are several"
    )
    bag.add_argument("--cloud-topic", metavar="TOPIC", help="PointCloud2, where there are several")
    bag.add_argument(
        "--info-topic", metavar="TOPIC", help="CameraInfo (default: camera_info beside the images)"
    )
    bag.add_argument(
        "--mask-topic",
        metavar="TOPIC",
        help="masks with the stamps of their images; the field label of the clouds is then read, too",
    )
    bag.add_argument(
        "--stamps",
        choices=("header", "received"),
        help="stamps of the headers (default), or the times of recording, where headers have none",
    )


def _add_label_options(command: argparse.ArgumentParser) -> None:
    """Labels in the place of the data's own."""
    networks = command.add_argument_group("labels by networks (docs/how-to/networks.md)")
    _add_networks(networks)
    networks.add_argument(
        "--labels",
        metavar="DIR",
        help="folder of labels that segment wrote; labels that networks make now are kept there, too",
    )


def _add_networks(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--image-model",
        metavar="MODEL",
        help="label the pictures: a YAML file that describes an ONNX network, a folder with a model of "
        "Hugging Face, or hf:NAME",
    )
    group.add_argument(
        "--lidar-model",
        metavar="MODEL",
        help="label the scans: a YAML file that describes an ONNX network on range images, or a folder of "
        "lidar-bonnetal",
    )


def _add_settings(command: argparse.ArgumentParser) -> None:
    """Settings of the stage's configuration."""
    settings = command.add_argument_group("settings")
    settings.add_argument("--config", type=Path, metavar="FILE", help="settings as JSON or TOML")
    settings.add_argument(
        "--set",
        dest="settings",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="one setting, such as a.b=0.5 (repeatable; after --config)",
    )
