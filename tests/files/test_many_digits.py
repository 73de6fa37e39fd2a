"""Whole numbers of thousands of digits, which Python neither reads nor prints, in every kind of file."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sst_graph.data.folder.camera_file import read_camera
from sst_graph.data.point_files import read_cloud
from sst_graph.errors import DataError, SstGraphError
from sst_graph.files.reading import SETTINGS, parse_json, parse_toml, read_json
from sst_graph.files.yaml_file import number, numbers, parse_yaml, read_yaml
from sst_graph.imports.document import read_document
from sst_graph.rig.known_files import read_known_poses

DIGITS = {
    "400": "9" * 400,
    "4000": "9" * 4000,
    "5000": "9" * 5000,
    "negative": "-" + "9" * 5000,
    "hexadecimal": "0x" + "f" * 6000,
    "octal": "0o" + "7" * 9000,
    "octal of YAML 1.1": "0" + "7" * 9000,
    "binary": "0b" + "1" * 16000,
    "sexagesimal": ":".join(["59"] * 3000),
    "with underscores": "9_" * 5000 + "9",
}
PCD = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nHEIGHT 1\nDATA ascii\n1 2 3\n"
PLY = "ply\nformat ascii 1.0\nelement vertex 1\n{}end_header\n1 2 3\n".format(
    "".join(f"property float {axis}\n" for axis in "xyz")
)
CAMERA = "fx: 300\nfy: 300\ncx: 160\ncy: 60\nwidth: 320\nheight: 120\nD: [0, 0, 0, 0]\n"


def _npy(shape: str) -> bytes:
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".encode()
    header += b" " * (-(len(header) + 13) % 64) + b"\n"
    return b"\x93NUMPY\x02\x00" + len(header).to_bytes(4, "little") + header


FILES: dict[str, tuple[Callable[[Path], Any], Callable[[str], str | bytes]]] = {
    "value.json": (lambda path: read_json(path, SETTINGS), lambda digits: f'{{"a": [{digits}]}}'),
    "value.toml": (lambda path: parse_toml(path.read_text(), path), lambda digits: f"a = [{digits}]"),
    "value.yaml": (lambda path: number(read_yaml(path)["a"], "a"), lambda digits: f"a: {digits}"),
    "list.yaml": (lambda path: numbers(read_yaml(path)["a"], "a"), lambda digits: f"a: [1, {digits}]"),
    "name.yaml": (read_yaml, lambda digits: f"? {digits}\n: 1"),
    "document.yaml": (lambda path: read_document(path).yaml, lambda digits: f"a: 1\n---\na: {digits}"),
    "document.json": (lambda path: read_document(path).json, lambda digits: f"[{digits}]"),
    **{
        f"{name}-camera.yaml": (
            read_camera,
            lambda digits, name=name: re.sub(rf"(?m)^{name}: .*$", f"{name}: {digits}", CAMERA),
        )
        for name in ("fx", "cx", "width", "height", "D")
    },
    **{
        f"{name.strip()}.pcd": (
            read_cloud,
            lambda digits, name=name: re.sub(rf"(?m)^{name} \S+", f"{name} {digits}", PCD),
        )
        for name in ("SIZE", "WIDTH", "HEIGHT")
    },
    "count.pcd": (read_cloud, lambda digits: PCD.replace("WIDTH", f"COUNT 1 {digits} 1\nWIDTH")),
    "both.pcd": (read_cloud, lambda digits: re.sub(r"(WIDTH|HEIGHT) 1", rf"\1 {digits}", PCD)),
    "words.pcd": (read_cloud, lambda digits: PCD.replace("F F F", "U U U").replace("1 2 3", f"1 2 {digits}")),
    "camchain.yaml": (
        lambda path: read_known_poses(path, ["cam0", "cam1"], 0.02, 0.001),
        lambda digits: f"? cam{digits}\n: {{a: 1}}\n? cam1\n: {{a: 1}}\n",
    ),
    "count.ply": (read_cloud, lambda digits: PLY.replace("vertex 1", f"vertex {digits}")),
    "length.npy": (read_cloud, lambda digits: _npy(f"({digits}, 3)")),
    "lengths.npy": (read_cloud, lambda digits: _npy(f"({digits}, {digits})")),
}


@pytest.mark.parametrize("form", DIGITS)
@pytest.mark.parametrize("name", FILES)
def test_numbers_of_thousands_of_digits_are_refused_in_one_line(name: str, form: str, tmp_path: Path) -> None:
    read, content = FILES[name]
    written = content(DIGITS[form])
    path = tmp_path / name
    path.write_bytes(written if isinstance(written, bytes) else written.encode())
    try:
        found = read(path)
    except SstGraphError as error:
        assert "\n" not in str(error) and "set_int_max_str_digits" not in str(error)
    else:  # a text, where the format knows no such number
        assert "yaml" in name and DIGITS[form] in str(found)


def test_what_is_said_is_the_same_for_every_form() -> None:
    for digits in (DIGITS["5000"], DIGITS["hexadecimal"], DIGITS["400"]):
        with pytest.raises(DataError, match=r"x: found no YAML \(a whole number of more than 20 digits"):
            parse_yaml(f"a: {digits}", "x")
        with pytest.raises(DataError, match=r"x: found no TOML \(a whole number of more than 20 digits"):
            parse_toml(f"a = {digits}", "x")
    with pytest.raises(DataError, match=r"x: found no JSON \(a whole number of 5000 characters"):
        parse_json(DIGITS["5000"], "x")
