"""Arrays out of memory: they come back as they were, whatever happens to the file."""

from __future__ import annotations

import copy
import logging
import mmap
import pickle
import resource
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sst_graph.files import array_store
from sst_graph.files.array_store import ArrayStore, StoredArray, replaced, shape_of, storable


@storable("values")
@dataclass(frozen=True)
class Holder:
    name: str
    values: NDArray[np.float32]


def arrays() -> list[NDArray[np.generic]]:
    rng = np.random.default_rng(0)
    return [
        rng.normal(size=(5, 3)).astype(np.float32),
        rng.integers(0, 256, (4, 6), np.uint8),
        np.zeros((0, 3), np.float32),
        np.asarray(rng.normal(size=(4, 6))[:, ::2]),  # not contiguous
        np.array([True, False]),
    ]


def is_in_memory(stored: StoredArray) -> bool:
    """Whether it is the same array each time, and not another one that is read from the file."""
    return np.shares_memory(stored.get(), stored.get())


@pytest.mark.parametrize("in_memory_bytes", [0, 70, 10_000])
def test_what_is_put_comes_back(in_memory_bytes: int) -> None:
    store = ArrayStore(in_memory_bytes)
    kept = [(array, store.put(array)) for array in arrays()]
    for _ in range(2):
        for array, stored in kept:
            found = stored.get()
            assert (found.dtype, found.shape) == (array.dtype, array.shape)
            np.testing.assert_array_equal(found, array)
    in_memory = [array.nbytes for array, stored in kept if is_in_memory(stored)]
    assert in_memory == {0: [], 70: [60, 2], 10_000: [60, 24, 96, 2]}[in_memory_bytes]


def test_numpy_need_not_copy_an_array_to_look_up_values_in_it() -> None:
    store = ArrayStore(0)
    store.put(np.zeros(3, np.uint8))
    mapped, small = (store.put(np.zeros(count)).get() for count in (40_000, 10))
    assert mapped.flags.aligned and small.flags.aligned and mapped.ctypes.data % 64 == 0


def test_float32_comes_back_as_float64_without_loss() -> None:
    points = np.random.default_rng(1).normal(size=(7, 3)).astype(np.float32)
    found = ArrayStore(0).put(points, np.float64).get()
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, points.astype(np.float64))


def test_a_field_answers_the_array() -> None:
    values = np.arange(6, dtype=np.float32)
    plain, stored = Holder("a", values), Holder("a", ArrayStore(0).put(values))
    assert plain.values is values
    np.testing.assert_array_equal(stored.values, values)
    assert shape_of(plain, "values") == shape_of(stored, "values") == (6,)
    np.testing.assert_array_equal(replace(stored, name="b").values, values)
    with pytest.raises(AttributeError):  # frozen as before
        stored.values = values  # type: ignore[misc]


def test_other_fields_are_replaced_without_reading() -> None:
    store = ArrayStore(0)
    holder = Holder("a", store.put(np.arange(6, dtype=np.float32)))
    other = replaced(holder, name="b")
    assert (other.name, vars(other)["values"]) == ("b", vars(holder)["values"])
    store.__del__()  # closes the file: what is read now fails
    assert replaced(other, values=np.ones(2, np.float32)).values.tolist() == [1.0, 1.0]
    with pytest.raises(ValueError):
        _ = replaced(other, name="c").values


def test_copies_do_not_depend_on_the_file() -> None:
    values = np.arange(6, dtype=np.float32)
    store = ArrayStore(0)
    holder = Holder("a", store.put(values))
    copies = [pickle.loads(pickle.dumps(holder)), copy.deepcopy(holder)]
    store.__del__()  # closes the file
    with pytest.raises(ValueError):
        _ = holder.values
    for one in copies:
        np.testing.assert_array_equal(one.values, values)


def test_where_no_file_can_be_written_arrays_stay_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    store = ArrayStore(0)
    with caplog.at_level(logging.WARNING):
        kept = [(array, store.put(array)) for array in arrays()]
    for array, stored in kept:
        np.testing.assert_array_equal(stored.get(), array)
        assert is_in_memory(stored) or not array.size
    assert len(caplog.records) == 1


def test_a_file_that_may_not_grow() -> None:
    """As on a full disk: what was written before comes back all the same, the rest stays in memory."""
    store = ArrayStore(0)
    first, second = np.arange(4.0), np.arange(5.0)
    kept = store.put(first)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (first.nbytes, limits[1]))
    try:
        refused = store.put(second)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert is_in_memory(refused) and not is_in_memory(kept)
    np.testing.assert_array_equal(refused.get(), second)
    np.testing.assert_array_equal(kept.get(), first)


def test_nothing_is_left_in_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    store = ArrayStore(0)
    assert not is_in_memory(store.put(np.zeros(10_000)))
    assert list(tmp_path.iterdir()) == []


def test_large_arrays_are_mapped_and_small_ones_are_read() -> None:
    large, small = np.arange(100_000, dtype=np.int32).reshape(1000, 100), np.arange(7, dtype=np.int32)
    store = ArrayStore(0)
    stored = [store.put(small), store.put(large), store.put(small), store.put(large + 1)]
    found = [each.get() for each in stored]
    for array, expected in zip(found, [small, large, small, large + 1], strict=True):
        np.testing.assert_array_equal(array, expected)
    assert [array.flags.writeable for array in found] == [True, False, True, False]
    store.put(large)  # what is mapped stays where the file grows,
    np.testing.assert_array_equal(found[3], large + 1)
    store.__del__()  # and where it is closed
    np.testing.assert_array_equal(found[1], large)


def test_one_mapping_serves_many_arrays_and_then_another_one(monkeypatch: pytest.MonkeyPatch) -> None:
    large = np.arange(100_000, dtype=np.int32)
    store, mapped = ArrayStore(0), mmap.mmap
    stored = [store.put(large + k) for k in range(3)]
    made: list[int] = []

    def counted(*args: Any, **kwargs: Any) -> mmap.mmap:
        made.append(1)
        return mapped(*args, **kwargs)

    monkeypatch.setattr("mmap.mmap", counted)
    kept = [each.get() for _ in range(3) for each in stored]
    assert len(made) == 1
    monkeypatch.setattr(array_store, "_MAPPED_AT_ONCE", 2 * large.nbytes)
    kept += [each.get() for _ in range(3) for each in stored]
    assert len(made) == 4
    for k, array in enumerate(kept):  # those of an earlier mapping, too
        np.testing.assert_array_equal(array, large + k % 3)


def test_a_file_that_cannot_be_mapped_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    large = np.arange(100_000, dtype=np.int32)
    store = ArrayStore(0)
    stored = store.put(large)

    def refused(*args: object, **kwargs: object) -> None:
        raise OSError("no such device")

    monkeypatch.setattr("mmap.mmap", refused)
    np.testing.assert_array_equal(stored.get(), large)
