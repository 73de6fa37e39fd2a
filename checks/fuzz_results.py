"""Valid files of networks, rigs and batches, and what the fuzzer does to them."""

from __future__ import annotations

import dataclasses
import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from checks import fuzz_mutations as m
from checks.fuzz_layouts import ROOT, yaml_text
from sst_graph import open_source, read_result, read_rig
from sst_graph.fleet.batch import BatchConfig, write_summary
from sst_graph.fleet.drives import ListedDrive, find_drives, with_vehicles
from sst_graph.fleet.places import Place
from sst_graph.fleet.record import Cost, Numbers, Record
from sst_graph.rig.known_files import read_known_poses
from sst_graph.segmentation import open_image_segmenter, open_scan_segmenter, with_labels

Rng = np.random.Generator
NETWORKS, RIG, BATCH, STORE = "networks", "rig", "batch", "labels"
CHAIN = """cam0: {rostopic: /cam0/image, camera_model: pinhole}
cam1:
  T_cn_cnm1: [[1, 0, 0, -0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  rostopic: /cam1/image
"""
BONNETAL = {
    "arch_cfg.yaml": """dataset:
  sensor:
    fov_up: 3
    fov_down: -25
    img_prop: {width: 64, height: 16}
    img_means: [1, 0, 0, 0, 0]
    img_stds: [1, 1, 1, 1, 1]
post: {KNN: {use: True, params: {knn: 5, search: 5, sigma: 1.0, cutoff: 1.0}}}
""",
    "data_cfg.yaml": """labels: {0: unlabeled, 10: car, 40: road}
learning_map_inv: {0: 0, 1: 10, 2: 40}
learning_ignore: {0: true, 1: false}
""",
}


def write_results(drive: Path, result: Path, folder: Path) -> None:
    """Networks and the labels that one of them gives ``drive``, a rig, and lists and a record of a batch."""
    if str(ROOT / "tests") not in sys.path:
        sys.path.append(str(ROOT / "tests"))
    from rigs import marginal_of, result_of
    from tiny_networks import colour_yaml, range_yaml, write_colour_network, write_range_network

    networks, rig, batch = (folder / name for name in (NETWORKS, RIG, BATCH))
    for place in (networks / "bonnetal", rig, batch):
        place.mkdir(parents=True)
    colour_yaml(write_colour_network(networks / "colour.onnx"), "width: 16\nheight: 12\nresize: letterbox\n")
    range_yaml(write_range_network(networks / "range.onnx"), "fov_up: 10\nneighbours: {count: 5}\n")
    write_range_network(networks / "bonnetal" / "model.onnx")
    for name, text in BONNETAL.items():
        (networks / "bonnetal" / name).write_text(text)
    list(
        with_labels(open_source(drive), open_image_segmenter(networks / "colour.yaml"), None, folder / STORE)
    )
    found = result_of(marginal_of(2))
    (rig / "rig.json").write_text(found.to_json())
    for name, own in found.cameras.items():
        (rig / name).mkdir()
        (rig / name / "calibration.json").write_text(own.to_json())
    (rig / "chain.yaml").write_text(CHAIN)
    (batch / "list.csv").write_text(
        f"drive,name,vehicle,date\n{drive},a,v,2026-01-02\n{drive},b,v,20260103\n"
    )
    (batch / "list.txt").write_text(f"# drives\n{drive}\n/somewhere/else # another\n")
    numbers = Numbers.of(read_result(result))
    record = Record("a", str(drive), "ok", "", Cost(1, 1.0, 1.0, 10, 10), numbers)
    (batch / "record.json").write_text(record.to_json())


def networks(folder: Path, drive: Path, path: Path) -> None:
    """Load a network and label a frame by it."""
    frame = next(iter(open_source(drive)))
    assert frame.image is not None and frame.scan is not None
    if path.stem == "colour":
        open_image_segmenter(folder / NETWORKS / "colour.yaml").segment(frame.image)
    else:
        place = "range.yaml" if path.stem == "range" else "bonnetal"
        open_scan_segmenter(folder / NETWORKS / place).segment(frame.scan)


def labels(folder: Path, drive: Path, path: Path) -> None:
    """Read a drive with stored labels."""
    list(with_labels(open_source(drive), None, None, folder / STORE))


def rig(folder: Path, drive: Path, path: Path) -> None:
    """Read a rig, or a chain of cameras."""
    if path.suffix == ".yaml":
        read_known_poses(path, ("cam0", "cam1"))
        return
    found = read_rig(folder / RIG)
    found.to_json()
    for camera in found.cameras:
        found.relative_pose(camera, "cam0")


def batch(folder: Path, drive: Path, path: Path) -> None:
    """Read a list of drives, or sum up with a record of one."""
    if path.suffix != ".json":
        drives = with_vehicles(find_drives(str(path)), str(folder / BATCH / "list.csv"))
        json.dumps([one.day for one in drives])
        return
    record = Record.from_json(Place.of(path).read(), path)
    records = {name: dataclasses.replace(record, drive=name) for name in ("a", "b")}
    drives = [
        ListedDrive(name, Place.of(f"/drives/{name}"), "v", f"2026-01-0{k + 1}")
        for k, name in enumerate(records)
    ]
    out = folder / "summary"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    write_summary(drives, records, Place.of(out), BatchConfig())


KINDS: dict[str, tuple[Callable[[Path, Path, Path], None], tuple[tuple[str, m.Mutation], ...]]] = {
    "networks": (
        networks,
        (
            (f"{NETWORKS}/*.yaml", yaml_text),
            (f"{NETWORKS}/*/*.yaml", yaml_text),
            (f"{NETWORKS}/*.onnx", m.bytewise),
        ),
    ),
    "labels of networks": (
        labels,
        ((f"{STORE}/*/*/model.json", m.json_text), (f"{STORE}/*/*/*.png", m.image)),
    ),
    "rig": (
        rig,
        (
            (f"{RIG}/rig.json", m.json_text),
            (f"{RIG}/*/calibration.json", m.json_text),
            (f"{RIG}/*.yaml", yaml_text),
        ),
    ),
    "batch": (batch, ((f"{BATCH}/list.*", m.text), (f"{BATCH}/record.json", m.json_text))),
}
"""What reads a mutated file, and the files with their mutations, by the kind's name."""


def target(folder: Path, kind: str, rng: Rng) -> tuple[Path, m.Mutation]:
    """A file to be mutated, and how."""
    pattern, mutation = m.pick(rng, KINDS[kind][1])
    return m.pick(rng, sorted(folder.glob(pattern))), mutation
