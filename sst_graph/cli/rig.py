"""``sst-graph calibrate`` of several cameras on one LiDAR."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import gtsam
import numpy as np

from sst_graph.batch import CalibrationConfig
from sst_graph.batch.by_edges.choice import choice_for_cameras
from sst_graph.cli import EXIT_NOT_TRUSTED
from sst_graph.cli.inputs import calibration_settings, open_drives, starting_point
from sst_graph.cli.labels import check_classes
from sst_graph.cli.messages import complain, mention, say
from sst_graph.cli.output_places import check_apart
from sst_graph.cli.outputs import CALIBRATION, comparison, result_numbers, why_not_ok, write_calibration
from sst_graph.cli.progress import ProgressBar
from sst_graph.cli.reading import options_of, warn_of_other_pairs, with_images_read
from sst_graph.cli.video import video_of, videos_beside
from sst_graph.data.info.needed_labels import require_labels
from sst_graph.errors import ConfigError, count_of
from sst_graph.files import atomic_directory
from sst_graph.files.strict_json import strict_json
from sst_graph.inspect.report import ReferenceErrors, verdict_and_summary
from sst_graph.result import RIG_NAME, result_file
from sst_graph.rig import KnownPose, KnownRig, RelativePose, RigResult, calibrate_rig, read_rig
from sst_graph.rig.known import ROTATION_SIGMA_DEG, TRANSLATION_SIGMA_M, poses_by_nominal
from sst_graph.rig.known_files import read_known_poses
from sst_graph.rig.result import folder_names
from sst_graph.types import Source

_PRINTED = ("status", "reasons", "covariance", "camera_poses", "known")
"""What ``--json`` prints of ``rig.json``."""


def refuse_rig_options(args: argparse.Namespace) -> None:
    """Refuse what only several cameras have.

    Raises:
        ConfigError: such an option is given.
    """
    for option, value in (
        ("--rig", args.rig),
        ("--rig-sigma", args.rig_sigma),
        ("--one-trigger", args.one_trigger),
    ):
        if value:
            raise ConfigError(f"{option}: means something for several cameras only (--camera A B)")


def run_rig(args: argparse.Namespace, cameras: Sequence[str]) -> int:
    """Calibrate the cameras of ``args.data`` together, print the summaries, write a folder for each."""
    config = dataclasses.replace(calibration_settings(args), for_report=not args.no_report)
    folders = folder_names(tuple(cameras))
    paths = [] if args.video is None else [video_of(args.video, folders[name]) for name in cameras]
    _check_apart(args, paths)
    sigmas = _sigmas(args)
    with videos_beside(paths, args.out, args.overwrite) as videos:
        with atomic_directory(args.out, args.overwrite, CALIBRATION) as folder:
            sources, rig = _calibrated(args, cameras, config, sigmas)
            against = {name: comparison(result, sources[name]) for name, result in rig.cameras.items()}
            # The numbers first: what follows may find the disk full.
            if not args.json:
                _mention_rig(rig, against)
            files = {}
            for name, result in rig.cameras.items():
                own = folder / folders[name]
                own.mkdir()
                with_report = not args.no_report
                files[name] = write_calibration(own, result, sources[name], against[name], with_report)
            (folder / RIG_NAME).write_text(rig.to_json(), encoding="utf-8")
            written = [RIG_NAME, *(f"{folders[name]}/{file}" for name in files for file in files[name])]
            for name, video in zip(cameras, videos, strict=False):
                written += video.write_inside(folder, rig[name], sources[name])
        if not args.json:
            mention(f"{'wrote':<15} {args.out}: {', '.join(written)}")
        for name, video in zip(cameras, videos, strict=False):
            for path in video.write_beside(rig[name], sources[name]):
                if not args.json:
                    mention(f"{'wrote':<15} {path}")
    if args.json:
        of_camera = {
            name: {
                **result_numbers(result, against[name]),
                "out": str(args.out / folders[name]),
                "files": files[name],
            }
            for name, result in rig.cameras.items()
        }
        document = {key: value for key, value in rig.to_dict().items() if key in _PRINTED}
        say(strict_json({**document, "cameras": of_camera, "out": str(args.out), "files": written}))
    return _exit_code(rig)


def _check_apart(args: argparse.Namespace, videos: Sequence[Path]) -> None:
    rig_file = None if args.rig in (None, "dataset") else args.rig
    inputs = {"--init": args.init, "--config": args.config, "--rig": rig_file}
    outputs = {"--out": args.out, **{f"--video for {path.name}": path for path in videos}}
    for path in args.data:
        check_apart({"DATA": path, **inputs}, outputs)


def _calibrated(
    args: argparse.Namespace,
    cameras: Sequence[str],
    config: CalibrationConfig,
    sigmas: tuple[float, float],
) -> tuple[dict[str, list[Source]], RigResult]:
    """The drives of each camera, and their calibration, with progress on stderr."""
    of_camera = {name: argparse.Namespace(**{**vars(args), "camera": name}) for name in cameras}
    sources, read_as = _opened(of_camera)
    require_labels(list(sources.values()), config.method)
    config = _with_method(config, sources)
    check_classes(next(iter(sources.values())), config.classes, args.classes)
    initial, offsets_s = _starts(args.init, sources, read_as)
    known = KnownRig(_known_poses(args.rig, sources, *sigmas), one_trigger=args.one_trigger)
    with ProgressBar() as progress:
        rig = calibrate_rig(
            sources, initial, config, known, initial_time_offsets_s=offsets_s, progress=progress
        )
    results = {
        name: dataclasses.replace(result, read_as=with_images_read(read_as[name], sources[name]))
        for name, result in rig.cameras.items()
    }
    return sources, dataclasses.replace(rig, cameras=results)


def _mention_rig(rig: RigResult, against: Mapping[str, ReferenceErrors | None]) -> None:
    for name, result in rig.cameras.items():
        mention(f"{'camera':<15} {name}\n{verdict_and_summary(result, against[name])}\n")
    mention("\n".join(f"{name:<15} {text}".rstrip() for name, text in rig_lines(rig)))


def _opened(
    of_camera: Mapping[str, argparse.Namespace],
) -> tuple[dict[str, list[Source]], dict[str, dict[str, Any]]]:
    """The drives of each camera, and how they were read.

    Where each sensor has stamps of its own, ``--frames`` are those of the first camera; of the others the
    frames of the same span of time are used.
    """
    sources: dict[str, list[Source]] = {}
    read_as: dict[str, dict[str, Any]] = {}
    first: list[Any] = []
    for name, own in of_camera.items():
        spans = [drive.span_ns for drive in first if hasattr(drive, "span_ns")]
        if own.frames is None or not first or len(spans) < len(first):
            read_as[name], sources[name] = options_of(own), open_drives(own)
        else:
            own.frames = None
            read_as[name], whole = options_of(own), cast(list[Any], open_drives(own))
            cuts = [drive.within(span) for drive, span in zip(whole, spans, strict=True)]
            sources[name] = [drive[cut] for drive, cut in zip(whole, cuts, strict=True)]
            if len(cuts) == 1:
                read_as[name]["frames"] = f"{cuts[0].start}:{cuts[0].stop}"
        first = first or list(sources[name])
    return sources, read_as


def _with_method(config: CalibrationConfig, sources: Mapping[str, Sequence[Source]]) -> CalibrationConfig:
    """The settings with the method that the sources allow; it is said which cameras are why method auto
    leaves out the labels of the others."""
    config, without = choice_for_cameras(config, list(sources.values()))
    if without and len(without) < len(sources):
        names = [name for k, name in enumerate(sources) if k in without]
        complain(
            f"warning: {', '.join(names)}: found no labels, so all cameras are calibrated "
            "without them: label these images, or use the labels of the others by --method joint"
        )
    return config


def _starts(
    choice: str, sources: Mapping[str, Sequence[Source]], read_as: Mapping[str, Mapping[str, Any]]
) -> tuple[dict[str, gtsam.Pose3 | None], dict[str, float]]:
    """cTl and time offset [s] of each camera that ``--init`` asks for; a rig's result has those of each.

    Raises:
        ConfigError: a file that has one pose for two cameras.
    """
    path, is_file = Path(choice), choice not in ("dataset", "none")
    if is_file and (path.name == RIG_NAME or (path.is_dir() and not result_file(path).exists())):
        rig = read_rig(path)
        results = {name: rig[name] for name in sources}
        return (
            {name: result.T_camera_lidar for name, result in results.items()},
            {name: result.time_offset_s for name, result in results.items()},
        )
    initial, offsets_s = {}, {}
    for name, own in sources.items():
        warn_of_other_pairs(choice, read_as[name])
        initial[name], offsets_s[name] = starting_point(choice, own[0], name)
        same = [one for one in initial if one != name and _is_same(initial[one], initial[name])]
        if is_file and same:
            raise ConfigError(
                f"--init {choice}: found one pose for {same[0]} and {name}, expected one of each camera "
                "(the folder of a rig, or a file that names both)"
            )
    return initial, offsets_s


def _is_same(a: gtsam.Pose3 | None, b: gtsam.Pose3 | None) -> bool:
    return a is not None and b is not None and a.equals(b, 0.0)


def _known_poses(
    choice: str | None, sources: Mapping[str, Sequence[Source]], rotation_deg: float, translation_m: float
) -> tuple[KnownPose, ...]:
    """The poses between cameras that ``--rig`` asks for."""
    if choice is None:
        return ()
    if choice == "dataset":
        nominal = {name: own[0].nominal for name, own in sources.items()}
        return poses_by_nominal(nominal, rotation_deg, translation_m)
    return read_known_poses(Path(choice), list(sources), rotation_deg, translation_m)


def _sigmas(args: argparse.Namespace) -> tuple[float, float]:
    """Deviations of the known poses [deg], [m].

    Raises:
        ConfigError: not two numbers above 0, or no known poses.
    """
    if args.rig_sigma is None:
        return ROTATION_SIGMA_DEG, TRANSLATION_SIGMA_M
    if args.rig is None:
        raise ConfigError("--rig-sigma: expected with --rig")
    try:
        degrees, centimetres = (float(word) for word in args.rig_sigma.split(","))
    except ValueError:
        degrees = centimetres = float("nan")
    if not (1e-6 <= degrees <= 180.0 and 1e-4 <= centimetres <= 1e4):
        raise ConfigError(f"--rig-sigma {args.rig_sigma!r}: expected DEG,CM, as in 0.03,0.2")
    return degrees, 0.01 * centimetres


def rig_lines(rig: RigResult) -> list[tuple[str, str]]:
    """The rig in a few lines: status, poses between cameras with sigmas, what contradicts what."""
    rows = [("rig", f"{rig.status}, {count_of(len(rig.cameras), 'camera')}")]
    rows += [
        ("" if k else "camera poses", _pose_line(p)) for k, p in enumerate(rig.marginal().relative_poses())
    ]
    rows += [("reason", reason) for reason in rig.reasons]
    return rows


def _pose_line(pose: RelativePose) -> str:
    sigma = np.sqrt(np.diag(pose.covariance))
    x, y, z = 100.0 * pose.T_camera_reference.translation()
    angle = np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(pose.T_camera_reference.rotation())))
    degrees, centimetres = np.degrees(sigma[:3]).max(), 100.0 * sigma[3:].max()
    return (
        f"{pose.reference} in {pose.camera}: {angle:.2f} deg, {x:+.1f} {y:+.1f} {z:+.1f} cm "
        f"(sigma at most {degrees:.3f} deg, {centimetres:.2f} cm), time offset "
        f"{1e3 * pose.time_offset_s:+.2f} ms ± {1e3 * pose.time_offset_sigma_s:.2f} ms"
    )


def _exit_code(rig: RigResult) -> int:
    """3 where a camera is not ok; one line on stderr says which, and the first reason."""
    if rig.status == "ok":
        return 0
    bad = {name: result for name, result in rig.cameras.items() if result.status != "ok"}
    for name, result in bad.items():
        complain(f"{name}: {why_not_ok(result)}")
    return EXIT_NOT_TRUSTED
