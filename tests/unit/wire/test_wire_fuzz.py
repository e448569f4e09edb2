"""Mutated payloads of every type: a WireError or a value, nothing else, and no memory kept or blown up."""

import contextlib
import gc
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from companion.core import topics
from companion.runtime.wire import WireError, bundled_types, codec_of, wire_type

Decode = Callable[[bytes], Any]


def targets(random_value: Any, random_message: Any) -> list[tuple[Decode, bytes]]:
    """Decoders of all bundled types and of all topics, each with a few true payloads."""
    names = [n for n in bundled_types() if "/msg/" in n]
    names += [f"{n}_{half}" for n in bundled_types() if "/srv/" in n for half in ("Request", "Response")]
    rng = np.random.default_rng(1)
    found: list[tuple[Decode, bytes]] = []
    for name in names:
        wire = wire_type(name)
        found += [(wire.decode, wire.encode(random_value(wire, rng))) for _ in range(4)]
    for topic in topics.ALL:
        codec = codec_of(topic)
        found += [(codec.decode, codec.encode(random_message(topic.type, rng))) for _ in range(16)]
    return found


def mutated(payload: bytes, rng: np.random.Generator) -> bytes:
    """One to four changes: bits, counts, cuts, insertions, repeats."""
    data = bytearray(payload)
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(0, len(data) + 1))
        kind = rng.integers(6)
        if kind == 0 and at < len(data):
            data[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            data[at & ~3 : (at & ~3) + 4] = rng.choice([0, 1, 255, 2**16, 2**31, 2**32 - 1]).astype("<u4").tobytes()
        elif kind == 2:
            del data[at:]
        elif kind == 3:
            data[at:at] = rng.bytes(rng.integers(1, 9))
        elif kind == 4:
            del data[at : at + int(rng.integers(1, 9))]
        else:
            data[1:2] = bytes([int(rng.integers(4))])  # another byte order
    return bytes(data)


def attack(chosen: list[tuple[Decode, bytes]], count: int, seed: int) -> int:
    """How many of `count` mutated payloads were refused."""
    rng = np.random.default_rng(seed)
    refused = 0
    for i in range(count):
        decode, payload = chosen[i % len(chosen)]
        try:
            decode(mutated(payload, rng))
        except WireError as error:
            refused += 1
            assert len(str(error)) < 400
    return refused


def test_only_wire_errors_escape(random_value: Any, random_message: Any) -> None:
    refused = attack(targets(random_value, random_message), 20_000, seed=5)
    assert 5_000 < refused < 19_000  # so both ways out were taken


@pytest.mark.slow
def test_a_hundred_thousand_and_memory_flat(random_value: Any, random_message: Any) -> None:
    chosen = targets(random_value, random_message)
    for decode, payload in chosen:  # both byte orders: a reader is made when first needed
        decode(payload)
        with contextlib.suppress(WireError):
            decode(b"\0\0" + payload[2:])
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        refused = attack(chosen, 100_000, seed=7)
        gc.collect()
        after, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert 25_000 < refused < 95_000
    assert after - before < 100_000
    assert peak - before < 2_000_000  # payloads have some kB


@pytest.mark.parametrize("name", ["std_msgs/msg/Float64MultiArray", "nav_msgs/msg/Path", "sensor_msgs/msg/JointState"])
def test_a_huge_count_allocates_nothing(name: str) -> None:
    wire = wire_type(name)
    payload = bytearray(wire.encode({}))
    wire.decode(bytes(payload))
    tracemalloc.start()
    try:
        for at in range(4, len(payload) - 3, 4):
            with pytest.raises(WireError):
                changed = payload[:at] + b"\xff\xff\xff\x7f" + payload[at + 4 :]
                wire.decode(bytes(changed) if at >= 12 else b"")
        assert tracemalloc.get_traced_memory()[1] < 100_000
    finally:
        tracemalloc.stop()
