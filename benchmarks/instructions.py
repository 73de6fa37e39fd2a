"""Instructions that a call takes, counted by valgrind's callgrind: the same in every run, however busy the
machine is.

A program starts itself again under callgrind (:func:`rerun`), which counts nothing until :func:`count` asks
for it: by a client request, a few machine instructions that do nothing outside of valgrind. Inside of it the
processor looks the same on every machine (AVX2, no more), so that NumPy and OpenBLAS choose the same code
everywhere; OpenCV is kept to what it has for processors without AVX2.
"""

from __future__ import annotations

import ctypes
import gc
import mmap
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

REQUEST = bytes.fromhex("4889f8 31d2 48c1c703 48c1c70d 48c1c73d 48c1c733 4887db 4889d0 c3")
"""unsigned long request(unsigned long *arguments), of valgrind.h on x86-64: rax takes the arguments and rdx
the default answer, valgrind looks for the four rotations of rdi and the xchg, and rdx is the answer."""
RUNNING_ON_VALGRIND = 0x1001
DUMP_AT, ZERO, START, STOP = (0x43540000 + number for number in (3, 1, 4, 5))
"""Of callgrind.h."""


def missing() -> str | None:
    """Why nothing can be counted on this machine, or None."""
    if platform.machine() not in ("x86_64", "AMD64") or sys.platform != "linux":
        return f"instructions are counted on x86-64 Linux only, this is {platform.machine()} {sys.platform}"
    if shutil.which("valgrind") is None:
        return "valgrind is missing (apt install valgrind)"
    return None


def rerun(module: str, arguments: Sequence[str]) -> dict[str, int]:
    """What ``python -m module arguments`` counts under callgrind, by name."""
    with tempfile.TemporaryDirectory() as folder:
        command = ["valgrind", "-q", "--tool=callgrind", "--instr-atstart=no"]
        command += [f"--callgrind-out-file={folder}/counts", sys.executable, "-m", module, *arguments]
        fixed = {"PYTHONHASHSEED": "0", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        # OpenCV's AVX2 code has instructions that valgrind lacks.
        fixed |= {"OPENCV_CPU_DISABLE": "AVX2,FMA3", "OPENCV_IPP": "disabled"}
        done = subprocess.run(command, env=os.environ | fixed, text=True, capture_output=True)
        if done.returncode:
            raise SystemExit(f"valgrind ended with {done.returncode}:\n{done.stdout}{done.stderr}")
        return dict(_read(path) for path in Path(folder).glob("counts.*"))


def _read(path: Path) -> tuple[str, int]:
    """Name and instructions of one dump."""
    text = path.read_text()
    name = re.search(r"^desc: Trigger: Client Request: (.+)$", text, re.MULTILINE)
    total = re.search(r"^(?:summary|totals): (\d+)$", text, re.MULTILINE)
    if name is None or total is None:
        raise SystemExit(f"{path.name}: no counts in what callgrind wrote")
    return name[1], int(total[1])


def count(works: Mapping[str, Callable[[], object]], calls: int) -> None:
    """Count so many calls of each, after one that is not counted."""
    request = _Requests()
    if not request(RUNNING_ON_VALGRIND):
        raise SystemExit("not under valgrind")
    raise_without_flags()
    gc.disable()
    for name, work in works.items():
        work()
        gc.collect()
        request(START)
        request(ZERO)
        for _ in range(calls):
            work()
        request(DUMP_AT, name)
        request(STOP)


def raise_without_flags() -> None:
    """Let NumPy's Cholesky factorization raise under valgrind, which does not keep the flags of
    floating-point exceptions by which NumPy sees that a matrix is not positive definite."""
    factorize = np.linalg.cholesky

    def checked(a: NDArray[np.float64]) -> NDArray[np.float64]:
        root = np.asarray(factorize(a))
        if np.isnan(root).any():
            raise np.linalg.LinAlgError("Matrix is not positive definite")
        return root

    np.linalg.cholesky = checked  # type: ignore[assignment]


class _Requests:
    """Requests to valgrind; 0 is the answer outside of it."""

    def __init__(self) -> None:
        self._code = mmap.mmap(-1, mmap.PAGESIZE, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
        self._code.write(REQUEST)
        at = ctypes.addressof(ctypes.c_char.from_buffer(self._code))
        self._call = ctypes.CFUNCTYPE(ctypes.c_ulong, ctypes.POINTER(ctypes.c_ulong))(at)

    def __call__(self, number: int, text: str | None = None) -> int:
        buffer = ctypes.create_string_buffer((text or "").encode())
        first = ctypes.addressof(buffer) if text is not None else 0
        return int(self._call((ctypes.c_ulong * 6)(number, first, 0, 0, 0, 0)))
