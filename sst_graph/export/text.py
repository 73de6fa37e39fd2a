"""Numbers, names and comments in the text of files."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from sst_graph.cameras.estimated_camera import EstimatedCamera
from sst_graph.imports.frames import TIME_OFFSET_SENTENCE
from sst_graph.result import CalibrationResult

_PLAIN = re.compile(r"[A-Za-z_/][A-Za-z0-9_/.-]*")
_YAML_WORDS = {"y", "n", "yes", "no", "on", "off", "true", "false", "null"}

RECTIFIED = (
    "the camera is the pinhole to which sst_graph rectified the pictures of a {lens} lens: the extrinsic "
    "holds for both, the intrinsics for the rectified pictures alone"
)


def number(value: float) -> str:
    """Shortest text that reads back as the same number; with a point, or YAML 1.1 takes 1e-05 for text."""
    mantissa, e, exponent = repr(float(value) + 0.0).partition("e")
    return (mantissa if "." in mantissa else mantissa + ".0") + e + exponent


def numbers(values: object) -> list[str]:
    """:func:`number` of all entries of an array, row by row."""
    return [number(value) for value in np.asarray(values, dtype=np.float64).reshape(-1)]


def row(values: object) -> str:
    """Numbers with spaces between them."""
    return " ".join(numbers(values))


def yaml_rows(matrix: object, indent: int) -> str:
    """A matrix as a YAML list of its rows, one a line."""
    lines = [f"{' ' * indent}- [{', '.join(numbers(one))}]" for one in np.asarray(matrix, np.float64)]
    return "\n".join(lines)


def yaml_text(name: str) -> str:
    """A name as YAML takes it for text, with quotes where it would take it for something else."""
    plain = _PLAIN.fullmatch(name) and name.lower() not in _YAML_WORDS
    if plain:
        return name
    inner = "".join(c if c.isprintable() else "?" for c in name.replace("\\", "/").replace('"', "'"))
    return f'"{inner}"'


def heading(result: CalibrationResult, frame: str) -> list[str]:
    """What every file says of a camera's calibration; no line holds two hyphens in a row (XML).

    Args:
        frame: the camera's frame, as the file names it.
    """
    sigmas = result.sigmas()
    rx, ry, rz = sigmas.rotation_deg
    x, y, z = sigmas.translation_cm
    lines = [
        TIME_OFFSET_SENTENCE.format(frame=frame, value=number(result.time_offset_s)),
        f"one sigma, about and along the LiDAR's axes: rotation {rx:.3g} {ry:.3g} {rz:.3g} deg, "
        f"translation {x:.3g} {y:.3g} {z:.3g} cm, offset {sigmas.time_offset_ms:.3g} ms",
        *EstimatedCamera.of(result).sentences,
        *([RECTIFIED.format(lens=result.lens.replace("-", "_"))] if result.lens else []),
    ]
    if result.status != "ok":
        lines.append(f"STATUS {result.status}: these numbers are not to be trusted")
    own = [f"{drive.drive.replace('-', '_')} {drive.time_offset_s:+.6f} s" for drive in result.drive_offsets]
    return [*lines, f"offsets by drive: {', '.join(own)}"] if own else lines


def hashed(lines: Sequence[str]) -> str:
    """Comment lines of YAML and Python."""
    return "".join(f"# {line}\n" for line in lines)


def xml_comment(lines: Sequence[str]) -> str:
    """A comment of XML."""
    return "<!--\n" + "".join(f"  {line}\n" for line in lines) + "-->\n"
