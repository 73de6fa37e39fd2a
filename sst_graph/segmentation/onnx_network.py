"""An ONNX network that onnxruntime runs: loaded, its inputs described, its outputs checked."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import DataError, count_of, one_line, optional_module
from sst_graph.files.reading import FileKind, digest_of_file
from sst_graph.segmentation.label_numbers import LabelNumbers

NETWORK = FileKind("an ONNX network", 2**31)
"""Larger networks keep their weights in files of their own, for protobuf ends there."""
_WEIGHTS = FileKind("weights of an ONNX network", 2**36)
_DTYPES = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
}


class OnnxNetwork:
    """A network with one input.

    Attributes:
        path: of its file.
        digest: SHA-256 of the file, and of files of weights beside it that begin with its name.
        shape: of the input; None for dimensions that may vary.
        dtype: of the input.
        outputs: names of the outputs, in order.
    """

    def __init__(self, path: Path) -> None:
        """Loads the network.

        Raises:
            DataError: no such file, no network that loads, or other than one input of numbers.
            MissingDependencyError: onnxruntime is not installed.
        """
        runtime = _runtime(path)
        self.path, self.digest = path, _digest(path)
        options = runtime.SessionOptions()
        options.log_severity_level = 4  # what it has to say comes as an exception, too
        threads = os.environ.get("OMP_NUM_THREADS", "")
        options.intra_op_num_threads = int(threads) if threads.isdecimal() else 0
        self._session = _session(runtime, path, options)
        inputs, self.outputs = _described(self._session, path)
        if len(inputs) != 1:
            named = ", ".join(name for name, _, _ in inputs)
            raise DataError(
                path, f"{count_of(len(inputs), 'input')} ({named})", "one, the picture or the range image"
            )
        self._input, kind, shape = inputs[0]
        if kind not in _DTYPES:
            raise DataError(path, f"an input of {kind}", f"one of {', '.join(_DTYPES)}")
        self.dtype: Any = _DTYPES[kind]
        self.shape = tuple(size if isinstance(size, int) and size > 0 else None for size in shape)

    def identity(self, version: int, numbers: LabelNumbers, use: tuple[object, ...]) -> str:
        """Digest of the network and of what is done with it: labels are stored under it.

        Args:
            version: of the code that uses it.
            numbers: what its outputs mean.
            use: all else that the labels depend on.
        """
        classes = sorted((k, int(c)) for k, c in numbers.classes.items())
        parts = (version, self.digest, classes, numbers.others, *use)
        return hashlib.sha256(repr(parts).encode()).hexdigest()

    def check_input(self, expected: tuple[int | None, ...], layout: str) -> tuple[int | None, ...]:
        """The shape of the input, if it is the expected one where both know it.

        Args:
            layout: the shape in words, for errors.

        Raises:
            DataError: another number of dimensions, or another size.
        """
        sizes = zip(self.shape, expected, strict=False)
        if len(self.shape) != len(expected) or any(
            a != b for a, b in sizes if a is not None and b is not None
        ):
            raise DataError(self.path, f"an input of {_shown(self.shape)}", f"{_shown(expected)}, {layout}")
        return self.shape

    def run(self, values: NDArray[Any], place: str) -> dict[str, NDArray[Any]]:
        """Outputs by name.

        Args:
            values: the input, of any type of numbers.
            place: of the picture or scan, for errors.

        Raises:
            DataError: the network does not take it or fails, or an output is not finite.
        """
        if self.dtype == np.uint8:
            values = np.clip(np.rint(values), 0, 255)
        try:
            found = self._session.run(None, {self._input: np.ascontiguousarray(values, self.dtype)})
        except Exception as error:
            raise DataError(self.path, f"a failure on {place} ({one_line(error):.200})", "labels") from None
        outputs = dict(zip(self.outputs, (np.asarray(one) for one in found), strict=True))
        for name, array in outputs.items():
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise DataError(self.path, f"NaN or inf in its output {name} on {place}", "finite numbers")
        return outputs

    def output(self, outputs: Mapping[str, NDArray[Any]], name: str | None) -> NDArray[Any]:
        """The output of a name, or the first.

        Raises:
            DataError: there is none of this name.
        """
        wanted = self.outputs[0] if name is None else name
        if wanted not in outputs:
            raise DataError(self.path, f"outputs {', '.join(self.outputs)}", f"one called {wanted}")
        return outputs[wanted]


def _session(runtime: Any, path: Path, options: Any) -> Any:
    """The network on the first providers that take it, all or the processor alone.

    Raises:
        DataError: on neither.
    """
    every = runtime.get_available_providers()
    refusal: Exception | None = None
    for providers in (every, ["CPUExecutionProvider"]):
        try:
            # Not with the runtime's own fallback, which prints on stdout.
            return runtime.InferenceSession(str(path), options, providers=providers, enable_fallback=0)
        except Exception as error:  # its exceptions share no other base
            refusal = refusal or error
    assert refusal is not None
    raise DataError(path, f"no network that loads ({one_line(refusal):.200})", NETWORK.name) from None


def _described(session: Any, path: Path) -> tuple[list[tuple[str, str, tuple[Any, ...]]], tuple[str, ...]]:
    """Name, type and shape of each input, and the names of the outputs.

    Raises:
        DataError: names that are no text.
    """
    try:
        inputs = [(one.name, one.type, tuple(one.shape or ())) for one in session.get_inputs()]
        return inputs, tuple(one.name for one in session.get_outputs())
    except UnicodeDecodeError as error:
        raise DataError(path, f"names that are no UTF-8 ({one_line(error):.200})", NETWORK.name) from None


def _runtime(path: Path) -> Any:
    without = f"{path}: networks need onnxruntime, which is not installed"
    return optional_module("onnxruntime", without, "onnx")


def weights_beside(path: Path) -> list[Path]:
    """Files of weights of a network: those beside it that begin with its name."""
    return [one for one in sorted(path.parent.glob(f"{_escaped(path.name)}?*")) if one.is_file()]


def _digest(path: Path) -> str:
    digest = hashlib.sha256(digest_of_file(path, NETWORK))
    for beside in weights_beside(path):
        digest.update(beside.name.encode() + digest_of_file(beside, _WEIGHTS))
    return digest.hexdigest()


def _escaped(name: str) -> str:
    return "".join(f"[{c}]" if c in "*?[" else c for c in name)


def _shown(shape: tuple[int | None, ...]) -> str:
    return "x".join("any" if size is None else str(size) for size in shape) or "no dimensions"
