"""``sst-graph calibrate``: from drives on disk to a calibration."""

from __future__ import annotations

import argparse
import dataclasses
import logging
from collections.abc import Sequence

import gtsam

from sst_graph.batch import CalibrationConfig, calibrate
from sst_graph.batch.by_edges.choice import with_method_for
from sst_graph.cli.inputs import calibration_settings, open_drives, starting_point
from sst_graph.cli.labels import check_classes
from sst_graph.cli.messages import complain, mention, say
from sst_graph.cli.output_places import check_apart
from sst_graph.cli.outputs import CALIBRATION, comparison, exit_code, result_numbers, write_calibration
from sst_graph.cli.progress import ProgressBar
from sst_graph.cli.reading import given_cameras, options_of, warn_of_other_pairs, with_images_read
from sst_graph.cli.rig import refuse_rig_options, run_rig
from sst_graph.cli.video import videos_beside
from sst_graph.data.info.needed_labels import require_labels
from sst_graph.files import atomic_directory
from sst_graph.files.strict_json import strict_json
from sst_graph.inspect.report import ReferenceErrors, verdict_and_summary
from sst_graph.result import WALL_CLOCK, CalibrationResult
from sst_graph.types import Source

logger = logging.getLogger(__name__)


def run(args: argparse.Namespace) -> int:
    """Calibrate ``args.data``, print the summary of the result, write it."""
    cameras = given_cameras(args)
    if len(cameras) > 1:
        return run_rig(args, cameras)
    args.camera = cameras[0] if cameras else None
    refuse_rig_options(args)
    config = calibration_settings(args)
    inputs = {"DATA": None, "--init": args.init, "--config": args.config}
    for path in args.data:
        check_apart({**inputs, "DATA": path}, {"--out": args.out, "--video": args.video})
    paths = [] if args.video is None else [args.video]
    with videos_beside(paths, args.out, args.overwrite) as videos:
        with atomic_directory(args.out, args.overwrite, CALIBRATION) as folder:
            read_as = options_of(args)
            sources = open_drives(args)
            config = dataclasses.replace(with_method_for(config, sources), for_report=not args.no_report)
            require_labels([sources], config.method)
            if config.method not in ("motion", "edges"):
                check_classes(sources, config.classes, args.classes)
            elif args.classes is not None:
                complain(
                    f"note: --classes {args.classes}: without labels method edges is used, which aligns none"
                )
            warn_of_other_pairs(args.init, read_as)
            initial, time_offset_s = starting_point(args.init, sources[0], args.camera)
            result, against = calibrate_drives(sources, initial, time_offset_s, config, args.camera)
            result = dataclasses.replace(result, read_as=with_images_read(read_as, sources))
            # The numbers first: what follows may find the disk full.
            if not args.json:
                mention(verdict_and_summary(result, against))
            names = write_calibration(folder, result, sources, against, not args.no_report)
            for video in videos:
                names += video.write_inside(folder, result, sources)
        if not args.json:
            mention(f"{'wrote':<15} {args.out}: {', '.join(names)}")
        for video in videos:
            for path in video.write_beside(result, sources):
                if not args.json:
                    mention(f"{'wrote':<15} {path}")
    if args.json:
        say(strict_json({**result_numbers(result, against), "out": str(args.out), "files": names}))
    return exit_code(result)


def calibrate_drives(
    sources: Sequence[Source],
    initial: gtsam.Pose3 | None,
    initial_time_offset_s: float,
    config: CalibrationConfig,
    camera: str,
) -> tuple[CalibrationResult, ReferenceErrors | None]:
    """The calibration of ``sources``, with progress on stderr, and its errors where they can be known."""
    with ProgressBar() as progress:
        result = calibrate(
            sources, initial, config, initial_time_offset_s=initial_time_offset_s, progress=progress
        )
    for stage, seconds in result.diagnostics.get(WALL_CLOCK, {}).items():
        logger.info("%s took %.1f s", stage, seconds)
    result = dataclasses.replace(result, camera_name=camera)
    return result, comparison(result, sources)
