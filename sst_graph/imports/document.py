"""The text of a file of any format, parsed as what it is asked for."""

from __future__ import annotations

import ast
import warnings
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from sst_graph.errors import DataError, count_of, one_line
from sst_graph.files.reading import CALIBRATION, FileKind, parse_json, read_text
from sst_graph.files.yaml_file import YAML, parse_yaml

ANY = FileKind("a calibration in a format of docs/how-to/imports.md", CALIBRATION.max_bytes)
TREE = FileKind(
    "the vehicle's transforms as URDF, a launch file, tf messages or Autoware's", CALIBRATION.max_bytes
)

_MOST_CHARACTERS = {"XML": 4 << 20, "Python": 64 << 10, "YAML": YAML.max_bytes}


@dataclass(frozen=True)
class Document:
    """A text and where it was found.

    Attributes:
        path: the file, named in errors.
        text: all of it.
    """

    path: Path
    text: str

    @cached_property
    def json(self) -> Any:
        """The value of a JSON text.

        Raises:
            DataError: it is none.
        """
        return parse_json(self.text, self.path, ANY.name)

    @cached_property
    def yaml(self) -> dict[str, Any]:
        """The table of a YAML text; several documents that ``---`` separates are listed under ``documents``.

        Raises:
            DataError: it is none, or too long.
            MissingDependencyError: PyYAML is not installed.
        """
        self._check_length("YAML")
        parts = [part for part in _yaml_parts(self.text) if part.strip()]
        if len(parts) == 1:
            return parse_yaml(parts[0], self.path)
        if not parts:
            raise DataError(self.path, "an empty file", ANY.name)
        return {"documents": [parse_yaml(part, self.path) for part in parts]}

    @cached_property
    def xml(self) -> ET.Element:
        """The root of an XML text.

        Raises:
            DataError: no XML, a document type with entities, or too long.
        """
        self._check_length("XML")
        if "<!DOCTYPE" in self.text or "<!ENTITY" in self.text:
            raise DataError(self.path, "XML with a document type", "XML without one")
        try:
            return ET.fromstring(self.text)
        except (ET.ParseError, ValueError, LookupError) as error:
            raise DataError(self.path, f"no XML ({' '.join(str(error).split()):.200})", ANY.name) from None

    @cached_property
    def python(self) -> ast.Module:
        """The syntax tree of a Python text; nothing of it is run.

        Raises:
            DataError: no Python, or too long.
        """
        self._check_length("Python")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of odd escapes and literals in the text
                return ast.parse(self.text)
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            raise DataError(self.path, f"no Python ({one_line(error):.200})", ANY.name) from None

    def _check_length(self, language: str) -> None:
        most = _MOST_CHARACTERS[language]
        if len(self.text) > most:
            raise DataError(
                self.path, f"{language} of {count_of(len(self.text), 'character')}", f"at most {most}"
            )


def read_document(path: Path, kind: FileKind = ANY) -> Document:
    """A file's text; ``kind`` is for errors.

    Raises:
        DataError: missing, unreadable, too large or no UTF-8.
    """
    return Document(path, read_text(path, kind))


def _yaml_parts(text: str) -> list[str]:
    """Documents of a YAML text; what stands above the first ``---`` of OpenCV's files is directives only."""
    parts: list[list[str]] = [[]]
    for line in text.splitlines():
        if line.rstrip() == "---":
            parts.append([])
        else:
            parts[-1].append(line)
    kept = ["\n".join(part) for part in parts if any(_says_something(line) for line in part)]
    return kept or [text]


def _says_something(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith(("#", "%YAML"))
