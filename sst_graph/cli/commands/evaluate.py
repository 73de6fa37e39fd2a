"""``sst-graph evaluate``: a result against the truth."""

from __future__ import annotations

import argparse
import dataclasses
import json

from sst_graph.cli.inputs import result_with_information
from sst_graph.cli.messages import complain, say
from sst_graph.cli.options import SOURCE_DEFAULTS
from sst_graph.cli.reading import open_drive_of, reading_words
from sst_graph.errors import ConfigError, DataError
from sst_graph.inspect.report import OWN_CALIBRATION, error_lines
from sst_graph.metrics import TruthSigma, calibration_errors
from sst_graph.reference import read_reference
from sst_graph.result import CalibrationResult, result_file
from sst_graph.types import GroundTruth


def run(args: argparse.Namespace) -> int:
    """Print the errors of ``args.result`` against ``args.truth``."""
    result = result_with_information(args.result)
    truth = _truth(args, result)
    sigma = None if args.truth_sigma is None else _truth_sigma(args.truth_sigma)
    estimate = result.T_camera_lidar, result.time_offset_s
    errors = calibration_errors(*estimate, truth, result.covariance, sigma)
    if args.json:
        say(json.dumps({**dataclasses.asdict(errors), "status": result.status}, allow_nan=False))
    else:
        say("\n".join([*error_lines(errors), f"status       {result.status}"]))
    return 0


def _truth(args: argparse.Namespace, result: CalibrationResult) -> GroundTruth:
    """The truth in a file, or that of a data set, read as the drives of the result were; where the data say
    no more, their start.

    Raises:
        DataError: a file or data that cannot be read, or that bring none.
    """
    if args.truth.is_dir() and not result_file(args.truth).exists():
        nothing_given = argparse.Namespace(**dict.fromkeys(SOURCE_DEFAULTS))
        source = open_drive_of(nothing_given, args.truth, result, args.result)
        if source.truth is None:
            if source.nominal is None:
                raise DataError(args.truth, "data without a calibration", "a groundtruth.json or the like")
            complain(
                f"note: {source.name}: compared with the start that the data bring, not with a reference"
            )
            return GroundTruth(source.nominal, None)
        if getattr(source, "truth_is_reference", False):
            complain(f"note: {source.name}: {OWN_CALIBRATION}")
        return source.truth
    if result.read_as.get("image_shift"):
        complain(
            f"warning: {args.result} was made with {reading_words(result.read_as)}: "
            "the truth's time offset must be that of the same pairs"
        )
    return read_reference(args.truth, result.camera_name)


def _truth_sigma(text: str) -> TruthSigma:
    """The reference's sigmas from degrees, centimetres and milliseconds."""
    try:
        rotation_deg, translation_cm, offset_ms = (float(part) for part in text.split(","))
        return TruthSigma(rotation_deg, 0.01 * translation_cm, 1e-3 * offset_ms)
    except (ValueError, DataError):
        raise ConfigError(
            f"--truth-sigma {text!r:.60}: expected three numbers of 0 or more: ROT_DEG,TRANS_CM,MS"
        ) from None
