"""Files and folders wherever they stand: local paths without any package, URLs such as ``s3://`` by fsspec.

A remote folder cannot be renamed in one step. A result is therefore uploaded with its manifest last, and a
folder counts as whole only with a manifest (:data:`sst_graph.files.MANIFEST`).
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sst_graph.errors import DataError, MissingDependencyError, SstGraphError, one_line
from sst_graph.factors.arguments import checked_type
from sst_graph.files import MANIFEST, atomic_write_bytes
from sst_graph.files.reading import FileKind, read_file

_URL = re.compile(r"^[a-z][a-z0-9+.-]*://", re.IGNORECASE)
_AT_ONCE = 1000
"""Small files that are read in one request for many."""
_SMALL = FileKind("a list of drives or a file of a batch", 64 * 1024 * 1024)


@dataclass(frozen=True)
class Place:
    """A local path, or a URL that fsspec knows.

    Attributes:
        url: path or URL, without a slash at its end.
    """

    url: str

    @staticmethod
    def of(text: str | Path) -> Place:
        """The place that a user names.

        Raises:
            FactorError: no path.
        """
        checked_type("place", text, (str, Path), "a path or a URL")
        words = os.fspath(text)
        return Place(words.rstrip("/") or "/")

    @property
    def is_local(self) -> bool:
        """Whether it is a path of this machine."""
        return _URL.match(self.url) is None

    @property
    def name(self) -> str:
        """Last part of the path."""
        return self.url.rsplit("/", 1)[-1]

    def whole(self, folder: str = "") -> str:
        """The URL, or the path from the root; a relative one begins in a folder (the present one)."""
        return os.path.abspath(os.path.join(folder, self.url)) if self.is_local else self.url

    @property
    def path(self) -> Path:
        """As a path of this machine."""
        return Path(self.url)

    def __truediv__(self, below: str) -> Place:
        return Place(f"{self.url}/{below}")

    def __str__(self) -> str:
        return self.url

    def exists(self) -> bool:
        """Whether a file or a folder stands there.

        Raises:
            DataError: the storage cannot be asked.
        """
        if self.is_local:
            return os.path.lexists(self.url)
        with _asked(self):
            return bool(self._system().exists(self.url))

    def is_folder(self) -> bool:
        """Whether a folder stands there.

        Raises:
            DataError: the storage cannot be asked.
        """
        if self.is_local:
            return os.path.isdir(self.url)
        with _asked(self):
            return bool(self._system().isdir(self.url))

    def below(self) -> list[Place]:
        """What stands in the folder, by name; hidden entries are left out.

        Raises:
            DataError: no folder, or it cannot be listed.
        """
        return list(self.entries())

    def entries(self) -> dict[Place, bool]:
        """What :meth:`below` lists, and whether each is a folder.

        Raises:
            DataError: no folder, or it cannot be listed.
        """
        with _asked(self):
            if self.is_local:
                with os.scandir(self.url) as entries:
                    kinds = {one.name: one.is_dir() for one in entries}
            else:
                kinds = {}
                for one in self._system().ls(self.url, detail=True):
                    name = str(one["name"]).rstrip("/").rsplit("/", 1)[-1]
                    kinds[name] = kinds.get(name, False) or one["type"] == "directory"
        return {self / name: kinds[name] for name in sorted(kinds) if not name.startswith(".")}

    def matches(self) -> list[Place]:
        """What a pattern with ``*``, ``?``, ``[]`` or ``**`` names, by name.

        Raises:
            DataError: the storage cannot be asked.
        """
        if self.is_local:
            import glob

            return [Place.of(one) for one in sorted(glob.glob(self.url, recursive=True))]
        with _asked(self):
            system = self._system()
            return [Place.of(system.unstrip_protocol(one)) for one in sorted(system.glob(self.url))]

    def read(self) -> bytes:
        """The bytes of a file.

        Raises:
            DataError: it cannot be read.
        """
        with _asked(self):
            if self.is_local:
                return read_file(self.path, _SMALL)
            return bytes(self._system().cat_file(self.url))

    def write(self, data: bytes) -> None:
        """Write a file whole.

        Raises:
            OSError, DataError: it cannot be written.
        """
        if self.is_local:
            atomic_write_bytes(self.path, data)
            return
        with _asked(self):
            self._system().pipe_file(self.url, data)

    def remove(self) -> None:
        """Remove a file or a folder, if it is there."""
        if self.is_local:
            if os.path.isdir(self.url) and not os.path.islink(self.url):
                shutil.rmtree(self.url, ignore_errors=True)
            elif os.path.lexists(self.url):
                os.unlink(self.url)
            return
        with _asked(self):
            if self._system().exists(self.url):
                self._system().rm(self.url, recursive=True)

    def fetch(self, folder: Path) -> Path:
        """Copy a file or a folder into a local folder; the copy has its name.

        Raises:
            DataError: nothing there, or it cannot be read.
        """
        target = folder / self.name
        with _asked(self):
            system = self._system()
            if system.isdir(self.url):
                target.mkdir()
                system.get(self.url + "/", f"{target}/", recursive=True)
            else:
                system.get_file(self.url, str(target))
        return target

    def upload(self, folder: Path) -> None:
        """Copy a local folder to this place, its manifest last.

        Raises:
            DataError: it cannot be written.
        """
        files = sorted(one for one in folder.rglob("*") if one.is_file())
        files.sort(key=lambda one: one.name == MANIFEST)
        with _asked(self):
            system = self._system()
            for one in files:
                remote = f"{self.url}/{one.relative_to(folder).as_posix()}"
                system.makedirs(remote.rsplit("/", 1)[0], exist_ok=True)
                system.put_file(str(one), remote)

    def _system(self) -> Any:
        """The fsspec file system of the URL.

        Raises:
            MissingDependencyError: fsspec, or what it needs for this kind of URL, is not installed.
        """
        try:
            import fsspec

            system, _ = fsspec.core.url_to_fs(self.url, use_listings_cache=False)
        except ImportError as error:
            raise MissingDependencyError(
                f"{self.url}: needs fsspec and its package for this kind of URL ({error}): "
                "pip install 'sst-graph[fleet]'"
            ) from error
        except ValueError as error:
            raise DataError(self.url, str(error), "a path, or a URL that fsspec knows") from error
        return system


def read_many(places: Iterable[Place]) -> dict[Place, bytes]:
    """The bytes of many small files; those that are not there are left out.

    Raises:
        DataError: the storage cannot be asked.
    """
    listed = list(places)
    if not listed:
        return {}
    if listed[0].is_local:
        found = {}
        for place in listed:
            if place.exists():
                found[place] = place.read()
        return found
    found = {}
    for start in range(0, len(listed), _AT_ONCE):
        some = listed[start : start + _AT_ONCE]
        with _asked(some[0]):
            system = some[0]._system()
            by_path = {system._strip_protocol(place.url): place for place in some}
            contents = system.cat(list(by_path), on_error="omit")
            found |= {by_path[path]: bytes(data) for path, data in contents.items()}
    return found


@contextmanager
def _asked(place: Place) -> Iterator[None]:
    """Errors of a storage as :class:`DataError`, whatever its package calls them."""
    try:
        yield
    except SstGraphError:
        raise
    except FileNotFoundError as error:
        raise DataError(place.url, "nothing", "a file or a folder") from error
    except Exception as error:
        raise DataError(place.url, one_line(error), "a place that can be read and written") from error
