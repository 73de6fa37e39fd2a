"""The file of a recording, written by us: rerun's own writer waits for ever where a disk is full."""

from __future__ import annotations

import os
import threading
from pathlib import Path

_AT_ONCE = 1 << 20


class RecordedFile:
    """A file that takes what rerun writes into a pipe; an error of the disk is told, and the pipe drained.

    Attributes:
        pipe: the name by which rerun opens the pipe, before :meth:`begin`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._error: OSError | None = None
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o666)
        self._reader, self._writer = os.pipe()
        self.pipe = f"/dev/fd/{self._writer}"
        self._copying = threading.Thread(target=self._copy, daemon=True)
        self._copying.start()

    def begin(self) -> None:
        """rerun has opened the pipe, or will not: its end is the file's."""
        os.close(self._writer)

    def check(self) -> None:
        """Tell what has failed.

        Raises:
            OSError: the file cannot be written.
        """
        if self._error is not None:
            raise OSError(self._error.errno, self._error.strerror, str(self._path))

    def finish(self, longest_s: float) -> None:
        """Wait for the rest, after rerun has closed the pipe.

        Raises:
            OSError: the file cannot be written.
        """
        self._copying.join(longest_s)
        if self._copying.is_alive():
            raise OSError(f"{self._path}: the viewer rerun does not end it")
        self.check()

    def _copy(self) -> None:
        while data := os.read(self._reader, _AT_ONCE):
            self._write(data)
        os.close(self._reader)
        os.close(self._file)

    def _write(self, data: bytes) -> None:
        try:
            while data and self._error is None:
                data = data[os.write(self._file, data) :]
        except OSError as error:
            self._error = error
