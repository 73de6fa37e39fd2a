"""``sst-graph simulate``: a simulated drive on disk."""

from __future__ import annotations

import argparse

from sst_graph.cli.inputs import settings
from sst_graph.cli.progress import ProgressBar
from sst_graph.data.simulator import SimulationConfig, simulate, write_drive
from sst_graph.files import check_writable_target


def run(args: argparse.Namespace) -> int:
    """Simulate and write the drive that the options ask for."""
    flags = {
        "seed": args.seed,
        "frames": args.frames,
        "time_offset_s": args.delay,
        "motion": args.motion,
        "label_noise": args.label_noise,
        "rolling": args.rolling,
    }
    config = settings(SimulationConfig(), args, flags)
    check_writable_target(args.out, args.overwrite, owned_by="sequences")
    drive = simulate(config)
    with ProgressBar() as progress:
        write_drive(drive, args.out, overwrite=args.overwrite, progress=progress.stage("simulate"))
    print(f"wrote {args.out}: {len(drive)} frames, true time offset {1e3 * config.time_offset_s:+.1f} ms")
    return 0
