"""Valid tiny drives in the layouts besides KITTI odometry, and what the fuzzer does to them.

Files of KITTI raw, of a folder (clouds as .bin, .npy, .npz, .pcd, .ply), of nuScenes and of bags are mutated;
and messages field by field, in a bag that is written anew.
"""

from __future__ import annotations

import dataclasses
import io
import shutil
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from checks import fuzz_mutations as m
from sst_graph import open_source
from sst_graph.errors import SstGraphError

ROOT = Path(__file__).parents[1]
POINTS = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ring", "<u2"), ("time", "<f4"), ("label", "<u4")]
)

Rng = np.random.Generator


def write_layouts(odometry: Path, folder: Path) -> None:
    """The drive of ``odometry``, five frames of 12 points, in every other layout below ``folder``."""
    if str(ROOT / "tests") not in sys.path:
        sys.path.append(str(ROOT / "tests"))
    from bags import KINDS, bag_of
    from layouts import as_folder, as_kitti_raw, as_nuscenes

    plain = folder / "plain"
    shutil.copytree(odometry, plain)
    # The writers expect PNG files, and clouds without times of points.
    shutil.rmtree(plain / "velodyne_times")
    for path in sorted((plain / "image_2").glob("*.jpg")):
        cv2.imwrite(str(path.with_suffix(".png")), cv2.imread(str(path)))
        path.unlink()
    as_kitti_raw(plain, folder / "kitti-raw")
    as_nuscenes(plain, folder / "nuscenes")
    for kind in KINDS:
        bag_of(open_source(plain), folder / f"{kind}.bag" if kind == "ros1" else folder / kind, kind)
    _with_clouds_of_every_kind(as_folder(plain, folder / "folder"))


def _with_clouds_of_every_kind(drive: Path) -> None:
    """Clouds in formats of their own, a TIFF and a JPEG picture, stamps in a CSV file, a chain of cameras."""
    writers = (_npz, _npy, _pcd_ascii, _pcd_binary, _pcd_compressed, _ply_ascii, _ply_binary)
    table = np.zeros(12, POINTS)
    for name in "xyz":
        table[name] = np.random.default_rng(ord(name)).uniform(1.0, 20.0, 12)
    table["time"], table["label"] = np.linspace(0.0, 0.09, 12), 10
    clouds = drive / "clouds"
    last = max(float(path.stem) for path in clouds.iterdir())
    for k, writer in enumerate(writers):
        suffix = {"n": writer.__name__[1:], "p": writer.__name__[1:4]}[writer.__name__[1]]
        (clouds / f"{last + 0.1 * (k + 1):.9f}.{suffix}").write_bytes(writer(table))
    pictures = sorted((drive / "images").iterdir())
    for path, suffix in zip(pictures[:2], (".tif", ".jpg"), strict=True):
        cv2.imwrite(str(path.with_suffix(suffix)), cv2.imread(str(path)))
        path.unlink()
    lines = [f"{path.name},{path.stem}" for path in sorted((drive / "images").iterdir())]
    (drive / "images.csv").write_text("\n".join(["name,stamp_ns", *lines]) + "\n")


def _npz(table: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **{name: table[name] for name in table.dtype.names})
    return stream.getvalue()


def _npy(table: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, table)
    return stream.getvalue()


def _pcd_head(kind: str) -> bytes:
    types = {"x": "4 F", "y": "4 F", "z": "4 F", "ring": "2 U", "time": "4 F", "label": "4 U"}
    sizes, letters = (" ".join(value.split()[i] for value in types.values()) for i in (0, 1))
    lines = (
        "VERSION 0.7",
        f"FIELDS {' '.join(types)}",
        f"SIZE {sizes}",
        f"TYPE {letters}",
        "COUNT 1 1 1 1 1 1",
    )
    return "\n".join(
        (*lines, "WIDTH 12", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", "POINTS 12", f"DATA {kind}", "")
    ).encode()


def _rows(table: np.ndarray) -> bytes:
    return "".join(" ".join(map(str, row)) + "\n" for row in table.tolist()).encode()


def _pcd_ascii(table: np.ndarray) -> bytes:
    return _pcd_head("ascii") + _rows(table)


def _pcd_binary(table: np.ndarray) -> bytes:
    return _pcd_head("binary") + table.tobytes()


def _pcd_compressed(table: np.ndarray) -> bytes:
    """LZF with literals only: runs of at most 32 bytes behind their length."""
    data = b"".join(np.ascontiguousarray(table[name]).tobytes() for name in table.dtype.names)
    packed = b"".join(
        bytes([len(part) - 1]) + part for part in (data[i : i + 32] for i in range(0, len(data), 32))
    )
    sizes = np.array([len(packed), len(data)], "<u4").tobytes()
    return _pcd_head("binary_compressed") + sizes + packed


def _ply_head(kind: str) -> bytes:
    names = {"f4": "float", "u2": "ushort", "u4": "uint"}
    properties = [f"property {names[POINTS[name].str[1:]]} {name}" for name in POINTS.names or ()]
    return "\n".join(
        ("ply", f"format {kind} 1.0", "element vertex 12", *properties, "end_header", "")
    ).encode()


def _ply_ascii(table: np.ndarray) -> bytes:
    return _ply_head("ascii") + _rows(table)


def _ply_binary(table: np.ndarray) -> bytes:
    return _ply_head("binary_little_endian") + table.tobytes()


# --- mutations --------------------------------------------------------------------------------------------


def header(rng: Rng, data: bytes) -> bytes:
    """A PCD or PLY file: lines of its header, or bytes."""
    ends = [data.find(mark) + len(mark) for mark in (b"DATA ", b"end_header") if mark in data]
    if not ends or rng.random() < 0.3:
        return m.bytewise(rng, data)
    end = data.find(b"\n", ends[0]) + 1
    return m.text(rng, data[:end]) + data[end:]


def array_file(rng: Rng, data: bytes) -> bytes:
    """A .npy or .npz file: bytes, or other arrays in it."""
    if rng.random() < 0.5:
        return m.bytewise(rng, data)
    if rng.random() < 0.2 and not data.startswith(b"PK"):
        return npy_of(m.pick(rng, HEADERS))
    kind = m.pick(rng, ("<f8", "<i8", "|S3", "<c16", "|b1", "<M8[s]", ">f4", "<u8", "object"))
    shape = m.pick(rng, ((), (0,), (12,), (12, 3), (12, 4), (3, 12), (12, 0), (2, 2, 2), (12, 99)))
    values = np.full(shape, m.pick(rng, m.FLOATS))
    with np.errstate(all="ignore"):
        values = values.astype(kind)
    stream = io.BytesIO()
    if data.startswith(b"PK"):
        names = m.pick(
            rng, (("points",), ("x", "y", "z"), ("points", "label"), ("points", "time", "ring"), ("a",))
        )
        np.savez(stream, **{name: values for name in names})
    else:
        np.save(stream, values)
    return stream.getvalue()


def npy_of(header: str) -> bytes:
    """A .npy file of a header that NumPy would not write, and of zeros behind it."""
    written = header.encode()
    return b"\x93NUMPY\x01\x00" + len(written).to_bytes(2, "little") + written + bytes(48)


HEADERS = (
    "{'descr': ('<f4', (3,)), 'fortran_order': False, 'shape': (4,)}",
    "{'descr': [('x', '<f4'), ('x', '<f4')], 'fortran_order': False, 'shape': (6,)}",
    "{'descr': [('x', '<f4', (3,))], 'fortran_order': False, 'shape': (4,)}",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (-1, 3)}",
    "{'descr': '<f4', 'fortran_order': 1, 'shape': (True, 12)}",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (12,) * 3}",
    "__import__('os')",
)


def yaml_text(rng: Rng, data: bytes) -> bytes:
    """Lines of a YAML file with other values."""
    if rng.random() < 0.3:
        return m.bytewise(rng, data)
    lines = data.decode().split("\n")
    for _ in range(int(rng.integers(1, 3))):
        k = int(rng.integers(len(lines)))
        name, colon, _ = lines[k].partition(":")
        value = m.pick(
            rng,
            (
                *m.NUMBERS,
                *m.TEXTS,
                "[]",
                "{}",
                "[[1]]",
                "&a [*a]",
                "!!python/object:os.system x",
                "- 1",
                "2001-01-01",
            ),
        )
        lines[k] = f"{name}: {value}" if colon else value
    return "\n".join(lines).encode("utf-8", "surrogatepass")


FILES: dict[str, tuple[tuple[str, m.Mutation], ...]] = {
    "kitti-raw": (
        ("2011_09_26/calib_cam_to_cam.txt", m.text),
        ("2011_09_26/calib_velo_to_cam.txt", m.text),
        ("2011_09_26/*/velodyne_points/timestamps*.txt", m.text),
        ("2011_09_26/*/image_02/timestamps.txt", m.text),
        ("2011_09_26/*/velodyne_points/data/*", m.array("<f4", m.FLOATS)),
        ("2011_09_26/*/labels/*", m.array("<u4", m.LABELS)),
        ("2011_09_26/*/semantic_02/*", m.image),
    ),
    "folder": (
        ("camera.yaml", yaml_text),
        ("extrinsic.yaml", yaml_text),
        ("images.csv", m.text),
        ("images/*.tif", m.bytewise),
        ("images/*.jpg", m.image),
        ("masks/*", m.image),
        ("clouds/*.bin", m.array("<f4", m.FLOATS)),
        ("labels/*", m.array("<u4", m.LABELS)),
    ),
    "clouds": (
        ("clouds/*.np?", array_file),
        ("clouds/*.pcd", header),
        ("clouds/*.ply", header),
    ),
    "nuscenes": (
        ("v1.0-mini/*.json", m.json_text),
        ("s*/LIDAR_TOP/*", m.array("<f4", m.FLOATS)),
        ("lidarseg/v1.0-mini/*", m.bytewise),
        ("s*/CAM_FRONT/*", m.image),
    ),
    "bags": (
        ("ros1.bag", m.bytewise),
        ("sqlite3/*.db3", m.bytewise),
        ("sqlite3/metadata.yaml", yaml_text),
        ("mcap/*.mcap", m.bytewise),
        ("mcap/metadata.yaml", yaml_text),
    ),
}
"""Files of each layout, and how they are mutated."""
HOMES = {"clouds": "folder", "bags": ""}


def target(layouts: Path, kind: str, rng: Rng) -> tuple[Path, m.Mutation, Path]:
    """A file to be mutated, how, and the drive to be opened."""
    home = layouts / HOMES.get(kind, kind)
    pattern, mutation = m.pick(rng, FILES[kind])
    path = m.pick(rng, sorted(home.glob(pattern)))
    return path, mutation, (layouts / path.relative_to(layouts).parts[0]) if kind == "bags" else home


def read_all(drive: Path, rng: Rng) -> None:
    """Open a drive and read every frame."""
    options: dict[str, Any] = {"sequence": "61"} if drive.name == "nuscenes" else {}
    if drive.name in ("ros1.bag", "sqlite3", "mcap", "written.bag"):
        options = {"mask_topic": m.pick(rng, ("/front/mask", None))}
        if options["mask_topic"] is None:
            options["image_topic"] = "/front/image_rect"
    options["sweep"] = m.pick(rng, ("auto", "auto", "compensated", "clockwise"))
    source = open_source(drive, **options)
    for position in range(len(source)):
        # One damaged frame does not hide the next ones.
        with suppress(SstGraphError):
            source[position]
    list(source)


# --- messages ---------------------------------------------------------------------------------------------


def messages(layouts: Path, rng: Rng) -> None:
    """A bag written with one to three changed fields in its messages."""
    from bags import CLOUD, IMAGE, INFO, MASK, BagWriter, chain, table_of, writing

    source = open_source(layouts / "plain")
    path = layouts / "written.bag"
    path.unlink(missing_ok=True)
    bag: BagWriter
    with writing(path, "ros1") as bag:
        make = bag.messages
        found: list[tuple[str, Any, int]] = [
            ("/tf_static", make.transforms(chain(source.nominal)), 1),
            (INFO, make.info(source.camera), 1),
        ]
        for frame in source[:2]:  # type: ignore[index]
            stamp_ns = 10**18 + frame.scan.stamp_ns
            table = table_of(frame.scan, np.full(len(frame.scan.points), 10, np.uint32))
            found.append((CLOUD, make.cloud(stamp_ns, table), stamp_ns))
            found.append((IMAGE, _image(rng, make, stamp_ns, frame.image.pixels), stamp_ns))
            found.append((MASK, make.image(stamp_ns, np.zeros((6, 8), np.uint8), "mono8"), stamp_ns))
        for _ in range(int(rng.integers(1, 4))):
            k = int(rng.integers(len(found)))
            topic, message, received_ns = found[k]
            found[k] = topic, changed(rng, message), received_ns
        for topic, message, received_ns in found:
            # What does not fit into the message's types is not written.
            with suppress(Exception):
                bag.add(topic, message, received_ns)
    read_all(path, rng)


def _image(rng: Rng, make: Any, stamp_ns: int, pixels: np.ndarray) -> Any:
    """A picture; now and then in another encoding, or with fewer columns than its camera has."""
    if rng.random() < 0.8:
        return make.image(stamp_ns, pixels)
    encoding, channels = m.pick(rng, ENCODINGS)
    columns = pixels.shape[1] - int(rng.integers(3))
    shape = (len(pixels), columns) if channels == 1 else (len(pixels), columns, channels)
    return make.image(stamp_ns, np.full(shape, 90, np.uint8), encoding)


ENCODINGS = (("yuv422", 2), ("yuv422_yuy2", 2), ("rgba8", 4), ("mono8", 1), ("bayer_gbrg8", 1))
"""With their bytes a pixel."""


def changed(rng: Rng, message: Any) -> Any:
    """A message with one field of another value; of a nested message or a list, one of its own."""
    names = [field.name for field in dataclasses.fields(message) if field.name != "__msgtype__"]
    name = m.pick(rng, names)
    value = getattr(message, name)
    new: Any
    if dataclasses.is_dataclass(value):
        new = changed(rng, value)
    elif isinstance(value, list) and value:
        k = int(rng.integers(len(value)))
        some = (
            [*value[:k], changed(rng, value[k]), *value[k + 1 :]]
            if dataclasses.is_dataclass(value[k])
            else value
        )
        new = m.pick(rng, (some, some, value[:k], [*value, value[k]]))
    elif isinstance(value, np.ndarray):
        new = _changed_array(rng, value)
    elif isinstance(value, bool):
        new = not value
    elif isinstance(value, int):
        new = m.pick(rng, (0, 1, value + 1, max(value - 1, 0), 7, 255, 65_535, 2**31 - 1, 2**32 - 1, 100_000))
    elif isinstance(value, float):
        new = m.pick(rng, (0.0, -1.0, np.nan, np.inf, 1e300, 1e-300, 2.0 * value))
    else:
        new = m.pick(
            rng, (*m.TEXTS, "mono16", "bayer_rggb8", "yuv422", "equidistant", "rational_polynomial", "32FC1")
        )
    return dataclasses.replace(message, **{name: new})


def _changed_array(rng: Rng, value: np.ndarray) -> np.ndarray:
    if rng.random() < 0.3:
        return value[: int(rng.integers(len(value) + 1))]
    some = value.copy()
    if len(some):
        extremes = m.FLOATS if some.dtype.kind == "f" else (0, 1, 7, 127, 128, 255)
        with np.errstate(all="ignore"):
            some[rng.integers(len(some), size=int(rng.integers(1, 9)))] = m.pick(rng, extremes)
    return some
