"""Labels in the place of the data's own."""

from __future__ import annotations

import argparse


def add_label_options(command: argparse.ArgumentParser) -> None:
    """Labels in the place of the data's own."""
    networks = command.add_argument_group("labels by networks (docs/how-to/networks.md)")
    add_networks(networks)
    networks.add_argument(
        "--labels",
        metavar="DIR",
        help="folder of labels that segment wrote; labels that networks make now are kept there, too",
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
