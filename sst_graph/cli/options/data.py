"""How a drive is read and labelled: options of every command that takes a drive."""

from __future__ import annotations

import argparse

SOURCE_DEFAULTS: dict[str, str | int | float | None] = {
    "loader": "auto",
    "sequence": None,
    "frames": None,
    "camera": "image_2",
    "cloud": "velodyne",
    "lidar_pose": None,
    "image_shift": 0,
    "sweep": "auto",
    "sweep_start_deg": 180.0,
    "sweep_stamp": "forward",
    "image_topic": None,
    "cloud_topic": None,
    "info_topic": None,
    "camera_file": None,
    "mask_topic": None,
    "stamps": "header",
    "label_encoding": "auto",
    "image_model": None,
    "lidar_model": None,
    "labels": None,
}
"""How a drive is read where neither the command line nor a result says it. The parser leaves these options
None where they are not given: :mod:`sst_graph.cli.reading` fills them in."""


def add_source_options(command: argparse.ArgumentParser, several_cameras: bool = False) -> None:
    """How a drive is read."""
    source = command.add_argument_group("data")
    source.add_argument(
        "--loader",
        help="format: auto (default), kitti, kitti-raw, folder, nuscenes, ros, or an installed loader",
    )
    source.add_argument("--sequence", metavar="NN", help="sequence of a dataset folder, such as 00")
    source.add_argument("--frames", metavar="A:B", help="frames A to B-1 only")
    named = f"camera folder, nuScenes channel or image topic (default {SOURCE_DEFAULTS['camera']})"
    if several_cameras:
        source.add_argument(
            "--camera", nargs="+", action="extend", metavar="NAME", help=f"{named}; several: a rig"
        )
    else:
        source.add_argument("--camera", metavar="NAME", help=named)
    source.add_argument(
        "--cloud", help=f"folder of the scans (default {SOURCE_DEFAULTS['cloud']}), or a LiDAR of nuScenes"
    )
    source.add_argument(
        "--lidar-pose",
        metavar="X,Y,Z[,ROLL,PITCH,YAW]",
        help="T_cloud_lidar: where the LiDAR is in the axes of the clouds [m, deg], if these are not its own "
        "but, say, the vehicle's (base_link); calibrations are then of the LiDAR's axes",
    )
    source.add_argument(
        "--image-shift",
        type=int,
        metavar="N",
        help="image k+N gets the stamp of image k, which adds N periods of the camera to the true time "
        "offset",
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
        help="instant of a turn that a scan's stamp names, where times follow from azimuths (the laser faces "
        "forward, default, the turn begins or ends) or are of another clock (start or end); no data "
        "separate it from a time offset",
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
        "--camera-file",
        metavar="FILE",
        help="the camera, in the place of CameraInfo: a camera.yaml as of a folder, Kalibr's camchain, or "
        "OpenCV's or ROS's calibration",
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


def add_label_options(command: argparse.ArgumentParser) -> None:
    """Labels in the place of the data's own."""
    networks = command.add_argument_group("labels by networks (docs/how-to/networks.md)")
    add_networks(networks)
    networks.add_argument(
        "--labels",
        metavar="DIR",
        help="folder of labels that segment wrote; with networks, new labels are kept there, too",
    )


def add_networks(group: argparse._ArgumentGroup) -> None:
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
