"""Clouds in .bin, .npy, .npz, .pcd and .ply: read as libraries write them; refused where broken."""

from __future__ import annotations

import io
import re
import struct
import time
from pathlib import Path

import numpy as np
import pytest

from checks.fuzz_layouts import HEADERS, npy_of
from sst_graph.data.arrays import read_points
from sst_graph.data.point_files import read_cloud
from sst_graph.data.point_files.pcd import unpack_lzf
from sst_graph.data.point_times import seconds_after_stamp
from sst_graph.errors import DataError

DTYPE = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("intensity", "<f4"),
        ("ring", "<u2"),
        ("time", "<f4"),
        ("label", "<u4"),
    ]
)


def records(count: int = 50) -> np.ndarray:
    """A cloud with a point that is NaN."""
    rng = np.random.default_rng(count)
    values = np.zeros(count, DTYPE)
    for name in ("x", "y", "z"):
        values[name] = rng.uniform(-50.0, 50.0, count)
    values["intensity"] = rng.uniform(0.0, 1.0, count)
    values["ring"], values["time"] = rng.integers(0, 64, count), rng.uniform(-0.05, 0.05, count)
    values["label"] = rng.integers(0, 2**32, count, dtype=np.uint32)
    if count:
        values["x"][count // 2] = np.nan
    return values


def assert_read(path: Path, values: np.ndarray, exact: bool = True) -> None:
    cloud = read_cloud(path)
    compare = np.testing.assert_array_equal if exact else lambda a, b: np.testing.assert_allclose(a, b, 1e-6)
    compare(cloud.points(), np.stack([values[name] for name in "xyz"], axis=1))
    np.testing.assert_array_equal(cloud.rings(), values["ring"])
    np.testing.assert_array_equal(cloud.labels(), values["label"])
    offsets_s = cloud.offsets_s(0, np.ones(len(values), bool))
    assert offsets_s is not None
    compare(offsets_s, values["time"])


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_pcd_as_pypcd4_writes_it(tmp_path: Path, encoding: str) -> None:
    pypcd4 = pytest.importorskip("pypcd4")
    values = records()
    names = DTYPE.names or ()
    columns = [values[name] for name in names]
    cloud = pypcd4.PointCloud.from_points(columns, names, tuple(DTYPE[name].type for name in names))
    cloud.save(tmp_path / "a.pcd", encoding=pypcd4.Encoding(encoding))
    assert_read(tmp_path / "a.pcd", values, exact=encoding != "ascii")


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("order", ["<", ">"])
def test_ply_as_plyfile_writes_it(tmp_path: Path, text: bool, order: str) -> None:
    plyfile = pytest.importorskip("plyfile")
    values = records()
    vertices = plyfile.PlyElement.describe(values, "vertex")
    before = plyfile.PlyElement.describe(np.zeros(3, [("a", "i2"), ("b", "f8")]), "camera")
    faces = plyfile.PlyElement.describe(np.array([([0, 1, 2],)], [("vertex_indices", "O")]), "face")
    plyfile.PlyData([before, vertices, faces], text=text, byte_order=order).write(tmp_path / "a.ply")
    assert_read(tmp_path / "a.ply", values, exact=not text)


def test_numpy_files(tmp_path: Path) -> None:
    values = records()
    np.save(tmp_path / "a.npy", values)
    assert_read(tmp_path / "a.npy", values)
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **{name: values[name] for name in DTYPE.names or ()})
        assert_read(tmp_path / "a.npz", values)
    points = np.stack([values[name] for name in "xyz"], axis=1)
    np.save(tmp_path / "b.npy", np.asfortranarray(points, np.float64))
    np.testing.assert_array_equal(read_cloud(tmp_path / "b.npy").points(), points)
    for name in ("points", "xyz", "arr_0"):
        np.savez(tmp_path / "b.npz", **{name: points}, ring=values["ring"])
        np.testing.assert_array_equal(read_cloud(tmp_path / "b.npz").rings(), values["ring"])
        np.testing.assert_array_equal(read_cloud(tmp_path / "b.npz").points(), points[:, :3])
    np.savez(tmp_path / "b.npz", points=points, stamp=np.int64(5), frame=np.array("lidar"))
    np.testing.assert_array_equal(read_cloud(tmp_path / "b.npz").points(), points[:, :3])
    xyz = {axis: values[axis] for axis in "xyz"}
    np.savez(tmp_path / "b.npz", **xyz, normals=np.ones((len(points), 3)))
    np.testing.assert_array_equal(read_cloud(tmp_path / "b.npz").points(), points[:, :3])


@pytest.mark.parametrize("shape", [(6, 5), (2, 3, 4), (2, 3, 9)])
def test_arrays_with_more_values_a_point_or_in_rows_and_columns(
    tmp_path: Path, shape: tuple[int, ...]
) -> None:
    values = np.arange(np.prod(shape), dtype=np.float64).reshape(shape)
    table = values.reshape(6, -1)
    np.save(tmp_path / "a.npy", values)
    np.savez(tmp_path / "a.npz", cloud=values, ring=np.arange(6))
    for name in ("a.npy", "a.npz"):
        cloud = read_cloud(tmp_path / name)
        np.testing.assert_array_equal(cloud.points(), table[:, :3])
        np.testing.assert_array_equal(cloud.intensities(), table[:, 3])
    assert cloud.rings() is not None
    records = np.zeros((2, 3), [(axis, "<f4") for axis in "xyz"])
    records["y"] = np.arange(6).reshape(2, 3)
    np.save(tmp_path / "b.npy", records)
    assert read_cloud(tmp_path / "b.npy").points()[:, 1].tolist() == [0, 1, 2, 3, 4, 5]


def test_fields_as_cloudcompare_names_them(tmp_path: Path) -> None:
    values = records()
    names = {name: name if name in "xyz" else f"scalar_{name.capitalize()}" for name in DTYPE.names or ()}
    np.save(tmp_path / "a.npy", values.view([(names[name], DTYPE[name]) for name in DTYPE.names or ()]))
    assert_read(tmp_path / "a.npy", values)


def test_a_cloud_without_points(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(b"")
    np.save(tmp_path / "a.npy", records(0))
    for kind in ("ascii", "binary"):
        (tmp_path / f"{kind}.pcd").write_bytes(pcd(kind, 0, b""))
    (tmp_path / "a.ply").write_bytes(ply(0, b""))
    for path in tmp_path.iterdir():
        assert read_cloud(path).points().shape == (0, 3)


def test_times_count_in_any_unit_absolute_or_relative(tmp_path: Path) -> None:
    stamp_ns, offsets = 1_317_042_145_000_000_000, np.array([-0.05, 0.0, 0.05])
    xyz, used = {name: np.zeros(3) for name in "xyz"}, np.ones(3, bool)
    for name, values, precision in (
        ("t", np.rint(offsets * 1e9).astype(np.int64), 1e-9),
        ("timestamp", stamp_ns + np.rint(offsets * 1e9).astype(np.int64), 1e-9),
        ("timestamp", stamp_ns * 1e-9 + offsets, 1e-6),
        ("timestamp", stamp_ns + offsets * 1e9, 1e-6),
        ("time", offsets, 1e-9),
        ("t", np.rint(offsets * 1e6).astype(np.int32), 1e-9),
        ("timestamp", stamp_ns // 1000 + np.rint(offsets * 1e6).astype(np.int64), 1e-9),
    ):
        np.savez(tmp_path / "a.npz", **xyz, **{name: values})
        found = read_cloud(tmp_path / "a.npz").offsets_s(stamp_ns, used)
        np.testing.assert_allclose(found, offsets, atol=precision)
    np.savez(tmp_path / "a.npz", **xyz, time=np.array([0.1, np.nan, 3.0]))
    with pytest.raises(DataError, match=r"2 times that are NaN or beyond 1 s, first at index 1"):
        read_cloud(tmp_path / "a.npz").offsets_s(stamp_ns, used)
    assert read_cloud(tmp_path / "a.npz").offsets_s(stamp_ns, np.array([True, False, False])) is not None


@pytest.mark.parametrize(
    ("stamp_s", "after_s"),
    [*((stamp_s, s) for stamp_s in (0.0, 0.05, 0.1, 0.3, 0.85, 1.5) for s in (0.0, 0.001)), (0.3, -0.1)],
)
def test_times_in_the_first_second_of_a_clock(stamp_s: float, after_s: float) -> None:
    """Of a simulation, say; of stamps of the ends the first sweep shows nothing."""
    offsets, stamp_ns = np.linspace(after_s, 0.0998 + min(after_s, 0.0), 50), round(stamp_s * 1e9)
    for values in (offsets, stamp_s + offsets):
        found = seconds_after_stamp(values, stamp_ns)
        assert found is not None
        np.testing.assert_allclose(found, offsets, atol=1e-9)


def test_times_that_are_all_0_are_none(tmp_path: Path) -> None:
    """Drivers leave the field unfilled; a point that is left out may have any time."""
    xyz = {name: np.zeros(3) for name in "xyz"}
    for values in (np.zeros(3), np.zeros(3, np.int64), np.array([0.0, np.nan, 0.0])):
        np.savez(tmp_path / "a.npz", **xyz, time=values)
        used = np.array([True, False, True])
        assert read_cloud(tmp_path / "a.npz").offsets_s(1_317_042_145_000_000_000, used) is None


@pytest.mark.parametrize(
    ("extra", "order"),
    [
        *((extra, order) for extra in (-1, 0, 1, 2) for order in ("ring by ring", "firing by firing")),
        *((extra, "shuffled") for extra in (-1, 0, 1)),
    ],
)
def test_a_bin_says_how_many_values_a_point_has(tmp_path: Path, extra: int, order: str) -> None:
    """Neighbours have alike azimuths under the right number only. The size fits every number here."""
    rng = np.random.default_rng(3)
    rings, firings, half = 16, 900, np.radians(45.0)
    azimuths, ring = np.meshgrid(np.linspace(-half, half, firings), np.arange(rings))
    ranges = rng.uniform(5.0, 40.0, (rings, 1)) + rng.uniform(0.0, 1.0, (rings, firings))
    columns = [ranges * np.cos(azimuths), ranges * np.sin(azimuths), 0.03 * ranges * (ring - 8)]
    columns += [rng.integers(0, 255, ranges.shape), ring, np.linspace(0.0, 0.1, firings) * np.ones_like(ring)]
    grid = np.stack(columns[: 4 + extra], axis=-1).astype("<f4")
    rows = (grid if order == "ring by ring" else grid.transpose(1, 0, 2)).reshape(-1, 4 + extra)
    if order == "shuffled":
        rows = rng.permutation(rows)
    assert rows.size % 60 == 0
    (tmp_path / "a.bin").write_bytes(rows.tobytes())
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.bin").points(), rows[:, :3])
    points, intensities = read_points(tmp_path / "a.bin")
    np.testing.assert_array_equal(points, rows[:, :3])
    if extra < 0:
        assert intensities is None
    else:
        np.testing.assert_array_equal(intensities, rows[:, 3])


# --- broken files -----------------------------------------------------------------------------------------


def pcd(kind: str, count: int, body: bytes, **changes: str) -> bytes:
    header = {
        "VERSION": "0.7",
        "FIELDS": "x y z",
        "SIZE": "4 4 4",
        "TYPE": "F F F",
        "COUNT": "1 1 1",
        "WIDTH": f"{count}",
        "HEIGHT": "1",
        "POINTS": f"{count}",
        "DATA": kind,
    } | changes
    return "".join(f"{name} {value}\n" for name, value in header.items()).encode() + body


def ply(count: int, body: bytes, kind: str = "binary_little_endian", extra: str = "") -> bytes:
    properties = "".join(f"property float {name}\n" for name in "xyz") + extra
    return f"ply\nformat {kind} 1.0\nelement vertex {count}\n{properties}end_header\n".encode() + body


def npy(shape: tuple[int, ...], body: bytes, dtype: str = "<f4") -> bytes:
    stream = io.BytesIO()
    header = {"descr": dtype, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, header)
    return stream.getvalue() + body


TWELVE = struct.pack("<3f", 1.0, 2.0, 3.0)
MANY = 10**8

BROKEN = {
    "short.bin": (bytes(17), "17 bytes, expected a multiple of 16"),
    "units.bin": (struct.pack("<4f", 1e6, 0, 0, 0), "a coordinate of 1e\\+06 m"),
    "a.xyz": (b"", "the ending '.xyz'"),
    "a.npy": (b"PK", "no .npy file"),
    "objects.npy": (npy((1,), bytes(8), "|O"), "an array of object"),
    "many.npy": (npy((MANY, 3), TWELVE), "12 bytes behind the header"),
    "short.npy": (npy((2, 3), TWELVE), "12 bytes behind the header"),
    "wide.npy": (npy((1, 17), bytes(68)), r"an array of shape \(1, 17\)"),
    "negative.npy": (npy((-1, 3), TWELVE), "behind the header|no .npy file"),
    "a.npz": (b"PK\3\4 no zip", "no .npz file"),
    "a.pcd": (b"x y z\n1 2 3\n", "no line DATA"),
    "short.pcd": (pcd("binary", 2, TWELVE), "12 bytes of points, expected 24"),
    "many.pcd": (pcd("binary", MANY, TWELVE), "100000000 points"),
    "many-rows.pcd": (pcd("ascii", 0, b"", POINTS="1" + "0" * 30), "POINTS 10000"),
    "lines.pcd": (pcd("ascii", 2, b"1 2 3\n"), "1 line of points, expected 2"),
    "words.pcd": (pcd("ascii", 1, b"1 2 three\n"), "points that are no numbers"),
    "columns.pcd": (pcd("ascii", 1, b"1 2\n"), "points that are no numbers"),
    "type.pcd": (pcd("binary", 1, TWELVE, TYPE="F F C"), "field z of type C"),
    "counts.pcd": (pcd("binary", 1, TWELVE, SIZE="4 4"), "3 FIELDS, 3 TYPE, 2 SIZE, 3 COUNT"),
    "noxyz.pcd": (pcd("binary", 1, TWELVE, FIELDS="a b c"), "no field x"),
    "twice.pcd": (pcd("binary", 1, TWELVE, FIELDS="x x z"), "fields x x z"),
    "kind.pcd": (pcd("zip", 1, TWELVE), "DATA zip"),
    "lzf.pcd": (pcd("binary_compressed", 1, struct.pack("<II", 3, 12) + b"\xff\xff\xff"), "damaged LZF"),
    "lzf-short.pcd": (
        pcd("binary_compressed", 1, struct.pack("<II", 13, 12) + TWELVE),
        "12 compressed bytes",
    ),
    "lzf-size.pcd": (pcd("binary_compressed", 1, struct.pack("<II", 13, 2**31) + TWELVE), "unpacked bytes"),
    "a.ply": (b"plx\n", "no end_header"),
    "short.ply": (ply(2, TWELVE), "12 bytes of points, expected 24"),
    "many.ply": (ply(MANY, TWELVE), "100000000 points"),
    "list.ply": (ply(1, TWELVE, extra="property list uchar int i\n"), "a list in vertex"),
    "type.ply": (ply(1, TWELVE, extra="property complex c\n"), "a line 'property complex c'"),
    "lines.ply": (ply(2, b"1 2 3\n", "ascii"), "1 line of points"),
    "none.ply": (b"ply\nformat ascii 1.0\nelement face 0\nproperty int a\nend_header\n", "no element vertex"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_one_line(tmp_path: Path, name: str) -> None:
    content, found = BROKEN[name]
    (tmp_path / name).write_bytes(content)
    began = time.monotonic()
    with pytest.raises(DataError, match=found) as raised:
        read_cloud(tmp_path / name).points()
    assert str(raised.value).isprintable() and name in str(raised.value)
    assert time.monotonic() - began < 10.0  # not for ever; the machine may be busy


@pytest.mark.parametrize(("line", "words"), [("WIDTH", "1+1"), ("SIZE", "4 4 x"), ("POINTS", "")])
def test_a_pcd_header_names_the_line_that_is_wrong(tmp_path: Path, line: str, words: str) -> None:
    path = tmp_path / "a.pcd"
    content = pcd("ascii", 2, b"1 2 3\n" * 2, **{line: words})
    path.write_bytes(content if line != "WIDTH" else content.replace(b"POINTS 2\n", b""))
    with pytest.raises(
        DataError, match=rf"found {line} {re.escape(words)}, expected whole numbers in this line"
    ):
        read_cloud(path)


@pytest.mark.parametrize("header", HEADERS)
def test_a_header_that_numpy_does_not_write(tmp_path: Path, header: str) -> None:
    path = tmp_path / "a.npy"
    path.write_bytes(npy_of(header))
    with pytest.raises(DataError):
        read_cloud(path).points()


def test_a_zip_of_zeros_takes_no_memory(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", x=np.zeros(80_000_000, np.float64))
    with pytest.raises(DataError, match="1 array of 640000128 bytes, expected at most 64 of"):
        read_cloud(tmp_path / "a.npz")


def test_lzf_repeats_what_overlaps() -> None:
    # "ab", then 7 bytes from 2 back
    assert unpack_lzf(b"\x01ab\xa0\x01", 9, Path("a")) == b"ab" + b"abababa"
    with pytest.raises(DataError, match="damaged LZF block"):
        unpack_lzf(b"\x01ab\xa0\x01", 4, Path("a"))


@pytest.mark.parametrize("values", [[0, 1, 70000], [0, 1, -1], [0, 1, 0.5]])
def test_rings_that_are_none(tmp_path: Path, values: list[float]) -> None:
    np.savez(tmp_path / "a.npz", **{name: np.zeros(3) for name in "xyz"}, ring=np.array(values))
    with pytest.raises(DataError, match="at index 2, expected whole numbers, 0 to 65535"):
        read_cloud(tmp_path / "a.npz").rings()
