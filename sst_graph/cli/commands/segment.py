"""``sst-graph segment``: labels by networks, ahead of a calibration."""

from __future__ import annotations

import argparse

from sst_graph.cli.labels import expect_alignable, image_segmenter, scan_segmenter, store_to_fill
from sst_graph.cli.messages import mention
from sst_graph.cli.output_places import check_apart
from sst_graph.cli.progress import ProgressBar
from sst_graph.cli.reading import cameras_of_one_drive, open_drive
from sst_graph.errors import ConfigError, count_of
from sst_graph.segmentation import LabelledSource, Labelling, segment_drive


def run(args: argparse.Namespace) -> int:
    """Label ``args.data``, the pictures of each camera; what is stored already is not made again."""
    cameras = cameras_of_one_drive(args)
    if args.image_model is None and args.lidar_model is None:
        raise ConfigError("segment: found neither --image-model nor --lidar-model, expected one or both")
    check_apart(
        {"DATA": args.data[0], "--image-model": args.image_model, "--lidar-model": args.lidar_model},
        {"--out": args.out},
    )
    store = store_to_fill(args.out)
    images, scans = image_segmenter(args.image_model), scan_segmenter(args.lidar_model)
    expect_alignable((images, scans))
    args.image_model = args.lidar_model = None  # of the drive as the data have it
    for camera in cameras:
        args.camera = camera
        source = open_drive(args, args.data[0])
        drive = LabelledSource(source, Labelling.of(store, images, scans, stored=False))
        with ProgressBar() as progress:
            counts = segment_drive(drive, progress.stage("labels"))
        name = f"{drive.name}, {camera}" if len(cameras) > 1 else drive.name
        made = f"{count_of(counts['made'], 'label')} made, {counts['found']} found"
        mention(f"{name}: {made}, in {store.folder}")
    return 0
