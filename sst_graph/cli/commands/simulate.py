"""``sst-graph simulate``: a simulated drive on disk."""

from __future__ import annotations

import argparse

from sst_graph.cli.inputs import settings
from sst_graph.cli.messages import mention
from sst_graph.cli.output_places import check_apart
from sst_graph.cli.progress import ProgressBar
from sst_graph.errors import count_of
from sst_graph.files import atomic_directory
from sst_graph.simulator import DRIVE, SimulationConfig, fill_drive, simulate


def run(args: argparse.Namespace) -> int:
    """Simulate and write the drive that the options ask for."""
    flags = {
        "seed": args.seed,
        "frames": args.frames,
        "time_offset_s": args.time_offset,
        "motion": args.motion,
        "label_noise": args.label_noise,
        "rolling": args.rolling,
    }
    config = settings(SimulationConfig(), args, flags)
    check_apart({"--config": args.config}, {"OUT": args.out})
    with atomic_directory(args.out, args.overwrite, DRIVE) as folder, ProgressBar() as progress:
        drive = simulate(config)
        fill_drive(drive, folder, progress.stage("simulate"), args.stereo)
    mention(
        f"wrote {args.out}: {count_of(len(drive), 'frame')}, true time offset "
        f"{1e3 * config.time_offset_s:+.1f} ms"
    )
    return 0
