"""Mutations of input files: of bytes, text, arrays, JSON by its structure, images by their headers.

Every function takes a random generator and the bytes of a valid file and gives those of a mutated one.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import socket
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

Rng = np.random.Generator
Mutation = Callable[[Rng, bytes], bytes]

NUMBERS = [
    "0",
    "-0.0",
    "1",
    "-1",
    "0.5",
    "1e-300",
    "5e-324",
    "1e300",
    "1e308",
    "-1e308",
    "1e400",
    "-1e999",
    "1e999999999",
    "NaN",
    "nan",
    "Infinity",
    "-inf",
    "inf",
    "1e9",
    "1e-9",
    "9223372036854775807",
    "9223372036854775808",
    "-9223372036854775809",
    "18446744073709551616",
    "4294967296",
    "2147483648",
    "0x10",
    "1_000",
    "1,5",
    "1e",
    "1e+",
    ".",
    "-",
    "+",
    "٣",
    "½",
    "true",
    "null",
    "9" * 400,
    "9" * 5000,
    "0." + "3" * 1000,
    "-" + "1" * 25,
]
"""Numbers as text that parsers and arithmetic stumble over."""

TEXTS = (
    "",
    " ",
    "a",
    "ok",
    "image_2",
    "\x00",
    "\x1b[31mred\x1b[0m",
    "line\nbreak: true",
    "\u202egnp",
    "\ud800",
    "x" * 100_000,
    "../../etc/passwd",
    "__class__",
    "sst_graph.tracker.tracker:Tracker",
    "%s%n{0}",
    "é" * 50,
)
VALUES: tuple[Any, ...] = (
    None,
    True,
    False,
    0,
    -1,
    1,
    2**31,
    2**63,
    -(2**63) - 1,
    10**30,
    0.0,
    -0.0,
    5e-324,
    1e-300,
    1e-12,
    1e9,
    1e19,
    1e150,
    1e300,
    1.7e308,
    -1e308,
    float("nan"),
    float("inf"),
    float("-inf"),
    [],
    {},
    [[]],
    [0] * 1000,
    {"a": {"b": []}},
)


def pick(rng: Rng, choices: Any) -> Any:
    """One of several, as it is (NumPy would convert it)."""
    return choices[int(rng.integers(len(choices)))]


# --- bytes ------------------------------------------------------------------------------------------------


def flip_bits(rng: Rng, data: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 9)) if data else 0):
        changed[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def truncate(rng: Rng, data: bytes) -> bytes:
    return data[: int(rng.integers(len(data) + 1))]


def remove_block(rng: Rng, data: bytes) -> bytes:
    start = int(rng.integers(len(data) + 1))
    return data[:start] + data[start + int(rng.integers(1, 65)) :]


def repeat_block(rng: Rng, data: bytes) -> bytes:
    start = int(rng.integers(len(data) + 1))
    end = min(len(data), start + int(rng.integers(1, 257)))
    return data[:end] + data[start:end] * int(rng.integers(1, 20)) + data[end:]


def insert_noise(rng: Rng, data: bytes) -> bytes:
    start = int(rng.integers(len(data) + 1))
    return data[:start] + rng.bytes(int(rng.integers(1, 65))) + data[start:]


def overwrite(rng: Rng, data: bytes) -> bytes:
    start = int(rng.integers(len(data) + 1))
    block = bytes([int(pick(rng, (0, 255, 32, 91, 123)))]) * int(rng.integers(1, 129))
    return data[:start] + block + data[start + len(block) :]


def something_else(rng: Rng, data: bytes) -> bytes:
    """Another kind of file altogether."""
    return pick(
        rng,
        (
            b"",
            b"\x00",
            b"\xff\xfe\x00\x00",
            b"<html>",
            b"PK\x03\x04" + bytes(26),
            b"\x89PNG\r\n\x1a\n",
            b"\xff\xd8\xff\xd9",
            b"\x93NUMPY\x01\x00v\x00{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
            b"\x80\x04\x95cos\nsystem\n",
            b"[" * 100_000,
            b'{"a":' * 50_000,
            b"a = " + b"[" * 100_000,
            b"1" * 5000,
            b"\n" * 100_000,
            b" " * 100_000,
            b"x" * 2_000_000,
            bytes(2_000_000),
        ),
    )


BYTES: tuple[Mutation, ...] = (
    flip_bits,
    truncate,
    remove_block,
    repeat_block,
    insert_noise,
    overwrite,
    something_else,
)


def bytewise(rng: Rng, data: bytes) -> bytes:
    """One or two of :data:`BYTES`."""
    for _ in range(int(rng.integers(1, 3))):
        data = pick(rng, BYTES)(rng, data)
    return data


# --- text -------------------------------------------------------------------------------------------------


def text(rng: Rng, data: bytes) -> bytes:
    """Lines of numbers: a word, a line or its separators changed."""
    if rng.random() < 0.3:
        return bytewise(rng, data)
    lines = data.decode("utf-8").split("\n")
    k = int(rng.integers(len(lines)))
    words = lines[k].split(" ")
    action = int(rng.integers(9))
    if action <= 3 and words:
        words[int(rng.integers(len(words)))] = pick(rng, NUMBERS)
        lines[k] = " ".join(words)
    elif action == 4:
        lines[k] = ""
    elif action == 5:
        lines.insert(int(rng.integers(len(lines))), lines[k])
    elif action == 6:
        lines = [lines[i] for i in rng.permutation(len(lines))]
    elif action == 7:
        lines[k] = (
            pick(rng, ("\t", "\x1b[2J", "\u2028", "\x00", "#", ":", "P2:", "Tr:", "9" * 300_000)) + lines[k]
        )
    else:
        lines[k] = " ".join(words[: int(rng.integers(len(words) + 1))])
    separator = pick(rng, ("\n", "\n", "\n", "\r\n", "\r", "\v", "\n\n"))
    return encoded(rng, separator.join(lines))


def encoded(rng: Rng, written: str) -> bytes:
    """Text as UTF-8; now and then with a byte order mark, in UTF-16, or with digits of another script."""
    if rng.random() < 0.9:
        return written.encode("utf-8", "surrogatepass")
    change = int(rng.integers(4))
    if change == 0:
        return b"\xef\xbb\xbf" + written.encode("utf-8", "surrogatepass")
    if change == 1:
        return written.encode(pick(rng, ("utf-16", "utf-16-be", "utf-32")), "surrogatepass")
    if change == 2:
        return written.translate({48 + k: 0x0660 + k for k in range(10)}).encode("utf-8", "surrogatepass")
    return written.replace(" ", "\x00 ", 2).encode("utf-8", "surrogatepass")


# --- JSON -------------------------------------------------------------------------------------------------


def json_nodes(document: Any) -> list[tuple[Any, Any]]:
    """(container, key) of every node below the root."""
    found: list[tuple[Any, Any]] = []
    waiting = [document]
    while waiting:
        node = waiting.pop()
        keys = list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
        for key in keys:
            found.append((node, key))
            waiting.append(node[key])
    return found


def mutate_json(rng: Rng, document: Any) -> Any:
    """The document (changed in place) with one to three nodes of another value, type, size or place."""
    for _ in range(int(rng.integers(1, 4))):
        nodes = json_nodes(document)
        if not nodes:
            return pick(rng, VALUES)
        holder, key = pick(rng, nodes)
        value = holder[key]
        action = int(rng.integers(8))
        if action <= 2:
            holder[key] = pick(rng, VALUES) if rng.random() < 0.75 else pick(rng, TEXTS)
        elif action == 3 and isinstance(value, (int, float)):
            holder[key] = value * 10.0 ** int(rng.integers(-30, 30)) * pick(rng, (1, -1))
        elif action == 4:
            del holder[key]
        elif action == 5 and isinstance(holder, list):
            holder.insert(int(rng.integers(len(holder) + 1)), value)
        elif action == 6:
            other, there = pick(rng, nodes)
            holder[key] = json.loads(json.dumps(other[there])) if there in range_or_keys(other) else None
        else:
            holder[key] = pick(rng, ([value], str(value), {"a": value}, [value] * 3))
    return document


def range_or_keys(holder: Any) -> Any:
    return holder if isinstance(holder, dict) else range(len(holder))


def json_text(rng: Rng, data: bytes) -> bytes:
    """A JSON file with a changed structure; sometimes with changed text."""
    if rng.random() < 0.2:
        return bytewise(rng, data)
    written = json.dumps(mutate_json(rng, json.loads(data)))
    if rng.random() < 0.1:
        written = twice_or_long(rng, written)
    return encoded(rng, written)


def twice_or_long(rng: Rng, written: str) -> str:
    """What json.dumps does not write: a key given twice, numbers of many digits, deep nesting, a comment."""
    change = int(rng.integers(5))
    if change == 0:
        return written.replace("{", '{"format": 1, ', 1)
    if change == 1:
        return written.replace(": 0", ": " + "9" * 5000, 1)
    if change == 2:
        return written.replace(": ", ": " + "[" * 3000 + "]" * 3000 + ", ", 1)
    if change == 3:
        return written.replace(".", ".e", 3)
    return "// comment\n" + written


def toml_text(rng: Rng, data: bytes) -> bytes:
    """A TOML file with words of other values."""
    if rng.random() < 0.2:
        return bytewise(rng, data)
    lines = data.decode().split("\n")
    for _ in range(int(rng.integers(1, 4))):
        k = int(rng.integers(len(lines)))
        name, equals, _ = lines[k].partition("=")
        value = pick(rng, (*NUMBERS, '"text"', "[]", "{}", "[[1]]", "1979-05-27", "'''", '"""', "{a = 1}"))
        lines[k] = (
            f"{name}={value}" if equals else pick(rng, ("[a", "[[b]]", "a." * 5000 + "a = 1", name, "= 1"))
        )
    return encoded(rng, "\n".join(lines))


# --- arrays and images ------------------------------------------------------------------------------------


def array(dtype: str, extremes: tuple[float, ...]) -> Mutation:
    """Mutation of a plain array: numbers to extremes, or bytes."""

    def mutation(rng: Rng, data: bytes) -> bytes:
        if rng.random() < 0.4:
            return bytewise(rng, data)
        values = np.frombuffer(data, dtype).copy()
        count = int(rng.integers(1, len(values) + 1))
        with np.errstate(all="ignore"):
            values[rng.integers(len(values), size=count)] = np.array(pick(rng, extremes)).astype(dtype)
        if rng.random() < 0.2:
            values = values[: int(rng.integers(len(values) + 1))]
        if rng.random() < 0.1:
            values = values.byteswap()
        return values.tobytes()

    return mutation


FLOATS = (np.nan, np.inf, -np.inf, 0.0, 1e-40, 1e38, -1e38, 9999.0, 10001.0, -1.0, 1e-6, 0.999, 1.001)
LABELS = (0, 1, 7, 10, 40, 65535, 65546, 2**32 - 1, 252, 259)


def image(rng: Rng, data: bytes) -> bytes:
    """A PNG or JPEG file: its header, its chunks, its compressed data, or bytes."""
    if rng.random() < 0.3:
        return bytewise(rng, data)
    if rng.random() < 0.2:
        return recoded(rng, data)
    return _png(rng, data) if data.startswith(b"\x89PNG") else _jpeg(rng, data)


SIZES = (0, 1, 2, 5, 7, 9, 255, 65_535, 60_000, 32_767, 2**20, 2**31 - 1, 2**32 - 1)


def recoded(rng: Rng, data: bytes) -> bytes:
    """The same picture as people save it by mistake: other depths, channels and formats, a wrong checksum."""
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    grey = pixels if pixels.ndim == 2 else pixels[..., 0]
    eight = grey.astype(np.uint8)
    action = int(rng.integers(8))
    if action == 0:
        return bytes(data[:-4]) + b"\x00\x00\x00\x00"
    if action == 1:  # the checksum of the header
        return data[:29] + bytes(4) + data[33:]
    if action == 2:
        return _palette(eight)
    made = {
        3: grey.astype(np.uint16) * 257,
        4: np.dstack([eight] * 4),
        5: np.dstack([eight.astype(np.uint16) * 257] * 4),
        6: np.dstack([eight] * 3),
        7: eight,
    }[action]
    suffix = pick(rng, (".bmp", ".tiff", ".webp")) if action == 7 else ".png"
    return bytes(cv2.imencode(suffix, made)[1])


def _palette(eight: np.ndarray) -> bytes:
    """A PNG file with a colour table, and rows of indices into it, of which some are beyond it."""
    height, width = eight.shape
    rows = b"".join(b"\x00" + row.tobytes() for row in eight)
    parts = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)),
        (b"PLTE", bytes(range(30))),
        (b"IDAT", zlib.compress(rows)),
        (b"IEND", b""),
    )
    return png_of(parts)


def _png(rng: Rng, data: bytes) -> bytes:
    chunks = png_chunks(data)
    action = int(rng.integers(6))
    if action <= 1:
        fields = list(struct.unpack(">IIBBBBB", chunks[0][1]))
        k = int(rng.integers(7))
        fields[k] = pick(rng, SIZES) if k < 2 else int(rng.integers(0, 20))
        chunks[0] = (b"IHDR", struct.pack(">IIBBBBB", *fields))
    elif action == 2:
        pixels = zlib.decompress(b"".join(part for kind, part in chunks if kind == b"IDAT"))
        pixels = pick(rng, BYTES[:6])(rng, pixels)
        chunks = [chunks[0], (b"IDAT", zlib.compress(pixels)), chunks[-1]]
    elif action == 3:
        k = int(rng.integers(len(chunks)))
        chunks[k] = (chunks[k][0], pick(rng, BYTES[:6])(rng, chunks[k][1]))
    elif action == 4:
        kind = pick(
            rng, (b"iCCP", b"tRNS", b"PLTE", b"zTXt", b"gAMA", b"eXIf", b"ABCD", b"acTL", b"IEND", b"IHDR")
        )
        chunks.insert(int(rng.integers(len(chunks) + 1)), (kind, rng.bytes(int(rng.integers(0, 40)))))
    else:
        chunks = [chunks[i] for i in rng.permutation(len(chunks))]
    return png_of(chunks)


def png_of(chunks: Iterable[tuple[bytes, bytes]]) -> bytes:
    """A PNG file of chunks, each with its right checksum."""
    body = (
        struct.pack(">I", len(part)) + kind + part + struct.pack(">I", zlib.crc32(kind + part))
        for kind, part in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(body)


def png_chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    """Kind and content of each chunk of a PNG file."""
    at, found = 8, []
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        found.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    return found


def _jpeg(rng: Rng, data: bytes) -> bytes:
    action = int(rng.integers(4))
    changed = bytearray(data)
    if action == 0:
        frame = data.find(b"\xff\xc0")
        struct.pack_into(">HH", changed, frame + 5, *(pick(rng, SIZES) & 0xFFFF for _ in range(2)))
        return bytes(changed)
    if action == 1:
        return data[: len(data) // 2] + b"\xff\xd9"
    if action == 2:
        scan = data.find(b"\xff\xda")
        return data[:scan] + flip_bits(rng, data[scan:])
    return data[:2] + b"\xff\xe1" + struct.pack(">H", int(rng.integers(65536))) + data[2:]


# --- checkpoints ------------------------------------------------------------------------------------------


def checkpoint(rng: Rng, data: bytes) -> bytes:
    """A tracker's npz file: its bytes; or its JSON or its arrays, and the checksum made again."""
    if rng.random() < 0.15:
        return bytewise(rng, data)
    if rng.random() < 0.03:
        return bomb(rng)
    with np.load(io.BytesIO(data)) as file:
        head, body = bytes(file["head"]), bytes(file["data"])
    action = int(rng.integers(8))
    if action <= 5:
        head = json.dumps(mutate_json(rng, json.loads(head))).encode()
    elif action == 6:
        body = pick(rng, BYTES[:6])(rng, body)
    else:
        head = pick(rng, BYTES[:6])(rng, head)
    digest = hashlib.sha256(len(head).to_bytes(8, "little") + head + body).digest()
    parts = {"head": head, "data": body, "sha256": digest}
    arrays: dict[str, Any] = {name: np.frombuffer(part, np.uint8) for name, part in parts.items()}
    stream = io.BytesIO()
    save = np.savez_compressed if rng.random() < 0.03 else np.savez
    save(stream, **arrays)
    return stream.getvalue()


def bomb(rng: Rng) -> bytes:
    """An npz file of half a megabyte that unpacks to half a gigabyte under the members' names."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("head", "data", "sha256"):
            archive.writestr(f"{name}.npy", bytes(1 << int(rng.integers(20, 27))))
    return stream.getvalue()


# --- special files ----------------------------------------------------------------------------------------


def make_special(rng: Rng, path: Path) -> str:
    """Put something in the place of a file that is no regular file of its size; its name."""
    kind = pick(
        rng, ("fifo", "socket", "folder", "loop", "dangling", "zero", "null", "sparse", "absent", "tty")
    )
    remove(path)
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "socket":
        # The name of a socket may have a hundred characters only.
        here = os.getcwd()
        os.chdir(path.parent)
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(path.name)
        os.chdir(here)
    elif kind == "folder":
        path.mkdir()
    elif kind == "sparse":
        with open(path, "wb") as stream:
            stream.truncate(1 << int(rng.integers(28, 40)))
    elif kind != "absent":
        target = {
            "loop": path.name,
            "dangling": "nowhere",
            "zero": "/dev/zero",
            "null": "/dev/null",
            "tty": "/dev/tty",
        }
        path.symlink_to(target[kind])
    return str(kind)


def remove(path: Path) -> None:
    """Whatever stands at a path."""
    if path.is_dir() and not path.is_symlink():
        path.rmdir()
    else:
        path.unlink(missing_ok=True)
