"""Laws of the shelf in a file: bytes come back, gaps are used again, and no name or descriptor is left."""

import gc
import os
import resource
import signal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.runtime.file_shelf import FileShelf

sizes = st.integers(0, 300_000)
acts = st.lists(st.one_of(sizes, st.tuples(st.integers(0, 50))), max_size=60)


@given(acts, st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_bytes_come_back_whatever_was_dropped_between(acts, seed):
    shelf, kept, rng = FileShelf(), {}, np.random.default_rng(seed)
    for act in acts:
        if isinstance(act, int):
            data = rng.bytes(act)
            number = shelf.put(data)
            assert number not in kept
            kept[number] = data
        elif kept:
            number = sorted(kept)[act[0] % len(kept)]
            shelf.drop(number)
            del kept[number]
    for number, data in kept.items():
        assert shelf.get(number) == data


def test_gaps_are_filled():
    shelf, rng = FileShelf(), np.random.default_rng(0)
    numbers = [shelf.put(rng.bytes(int(size))) for size in rng.integers(10_000, 60_000, 200)]
    first = shelf.file_bytes
    for _ in range(3000):
        shelf.drop(numbers.pop(int(rng.integers(len(numbers)))))
        numbers.append(shelf.put(rng.bytes(int(rng.integers(10_000, 60_000)))))
    assert shelf.file_bytes < 2 * first


def test_no_file_is_there_before_the_first_bytes_and_none_with_a_name_ever(tmp_path):
    def files():
        return len(os.listdir("/proc/self/fd"))

    before = files()
    shelf = FileShelf(tmp_path)
    assert files() == before
    shelf.put(b"a" * 5000)
    assert files() == before + 1
    assert not list(tmp_path.iterdir())
    del shelf
    gc.collect()
    assert files() == before


def test_what_fails_raises_and_damage_is_found(tmp_path):
    with pytest.raises(OSError):
        FileShelf(tmp_path / "none").put(b"a")
    shelf = FileShelf(tmp_path)
    number, other = shelf.put(b"a" * 5000), shelf.put(b"b" * 5000)
    os.pwrite(shelf._file, b"c", 100)
    with pytest.raises(OSError, match="damaged"):
        shelf.get(number)
    assert shelf.get(other) == b"b" * 5000
    os.ftruncate(shelf._file, 8192)
    with pytest.raises(OSError, match="too early"):
        shelf.get(other)


def test_a_full_disk_refuses_and_what_was_there_stays():
    """The limit of a file's size plays the full disk."""
    old, limits = signal.signal(signal.SIGXFSZ, signal.SIG_IGN), resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        shelf = FileShelf()
        number = shelf.put(b"a" * 50_000)
        resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, limits[1]))
        with pytest.raises(OSError):
            shelf.put(b"b" * 50_000)
        assert shelf.get(number) == b"a" * 50_000
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        again = shelf.put(b"c" * 50_000)
        assert (shelf.get(again), shelf.get(number)) == (b"c" * 50_000, b"a" * 50_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, old)
