"""Memory of the map over a long flight: the same scans into two processes, one of which puts nothing away.

figures = memory_figures(length_m=1000.0, resolution_m=0.1)

Of the map alone, with decay and a shelf as in flight: the local maps that a flight makes of it are
messages, and take their own memory, as does what corrections need.
"""

from __future__ import annotations

import gc
import hashlib
import struct
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.core.errors import CompanionError
from companion.mapping.decay import Decay, DecayConfig
from companion.mapping.memory import MemoryConfig
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig
from companion.runtime.bench.mapping_kilometre import LongScan, fly_along, look_from, make_long_forest
from companion.runtime.file_shelf import FileShelf

STEP_M = 0.5  # between scans: 5 m/s at 10 Hz
_SAMPLE_EVERY = 50  # scans per look at the memory
_BACK_SCANS = 10  # at the start, after the whole way
_SIZE = struct.Struct("<q")


class _Task(msgspec.Struct, frozen=True):
    """What a side does."""

    resolution_m: float
    evict: bool


class _Sent(msgspec.Struct, frozen=True):
    """A scan on its way to a side."""

    points: bytes
    misses: bytes
    R: bytes
    p: bytes
    stamp_ns: int


class Side(msgspec.Struct, frozen=True, kw_only=True):
    """What a side measured of itself; memory is its growth since before there was a map, 10^6 bytes."""

    rss_growth_mb: float  # at the end of the way
    peak_growth_mb: float  # largest on the way, as sampled
    scratch_mb: float  # of it, insertion's ray grid
    map_mb: float  # that the map says it has in memory
    spilled_mb: float  # and beside it in the temporary file
    file_mb: float  # size of that, gaps included
    blocks: int
    warm_blocks: int
    cold_regions: int
    compression: float  # bytes of the cold blocks' voxels per byte kept, in the file or in memory
    move_ms_p50: float  # CPU per scan, of bringing back and putting away
    move_ms_max: float
    insert_ms_p50: float  # CPU per scan, moves and decay included
    return_ms: float  # CPU of the scan back at the start: all that it needs at once
    forgotten_blocks: int
    digest: str  # of every bit of the map, back at the start


def memory_figures(*, length_m: float = 1000.0, resolution_m: float = 0.1, seed: int = 1) -> dict[str, float]:
    """Fly `length_m` through a forest, then jump back; figures of `Side`, those of the control as `plain_...`."""
    tasks = [_Task(resolution_m, True), _Task(resolution_m, False)]
    forest = make_long_forest(length_m, seed=seed)
    with ExitStack() as stack:
        sides = [_start(stack, task) for task in tasks]
        for number, scan in enumerate(fly_along(forest, step_m=STEP_M)):
            _tell(sides, scan, number)
        _end_way(sides)
        for number in range(10**6, 10**6 + _BACK_SCANS):
            _tell(sides, look_from(forest, 0.1 * (number - 10**6), number), number)
        _end_way(sides)
        lean, plain = (_answer(side) for side in sides)
    figures = {name: value for name, value in msgspec.to_builtins(lean).items() if name != "digest"}
    chosen = ("rss_growth_mb", "peak_growth_mb", "map_mb", "insert_ms_p50")
    figures |= {f"plain_{name}": getattr(plain, name) for name in chosen}
    return figures | {"identical_on_return": float(lean.digest == plain.digest), "length_m": length_m}


def _start(stack: ExitStack, task: _Task) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "companion.runtime.bench.mapping_memory"]
    side = stack.enter_context(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE))
    stack.callback(side.kill)
    _write(side, msgspec.msgpack.encode(task))
    return side


def _tell(sides: list[subprocess.Popen[bytes]], scan: LongScan, number: int) -> None:
    arrays = (scan.points_body, scan.miss_dirs_body, scan.R_odom_body, scan.p_odom)
    points, misses, R, p = (array.tobytes() for array in arrays)
    sent = msgspec.msgpack.encode(_Sent(points, misses, R, p, number * 10**8))
    for side in sides:
        _write(side, sent)


def _end_way(sides: list[subprocess.Popen[bytes]]) -> None:
    for side in sides:
        _write(side, b"")


def _write(side: subprocess.Popen[bytes], data: bytes) -> None:
    assert side.stdin is not None
    try:
        side.stdin.write(_SIZE.pack(len(data)) + data)
        side.stdin.flush()
    except BrokenPipeError:
        raise CompanionError(f"a side of the measurement ended with exit code {side.wait()}") from None


def _answer(side: subprocess.Popen[bytes]) -> Side:
    assert side.stdout is not None
    line = side.stdout.readline()
    if not line:
        raise CompanionError(f"a side of the measurement ended with exit code {side.wait()}")
    return msgspec.json.decode(line, type=Side)


def main() -> None:
    """One side: scans come on standard input, an empty one ends the way there, another the way back."""
    stream = sys.stdin.buffer
    task = msgspec.msgpack.decode(_read(stream), type=_Task)
    memory = MemoryConfig() if task.evict else MemoryConfig(keep_m=1e6, budget_mb=1e6)
    config = VoxelMapConfig(resolution_m=task.resolution_m, memory=memory)
    print(msgspec.json.encode(_measure(stream, config)).decode(), flush=True)


def _measure(stream: IO[bytes], config: VoxelMapConfig) -> Side:
    _warm_up()
    before = rss_mb()
    shelf = FileShelf()
    voxels, decay = VoxelMap(config, decays=True, shelf=shelf), Decay(DecayConfig())
    watch = _Watch(voxels)
    insert_ms, grown = [], [0.0]
    for number, sent in enumerate(_scans(stream)):
        insert_ms.append(_insert(voxels, decay, sent))
        if number % _SAMPLE_EVERY == 0:
            grown.append(rss_mb() - before)
    at_end, moves = rss_mb() - before, np.array(watch.moves_ms)
    memory, spilled_mb = voxels.memory, voxels.memory.spilled_bytes * 1e-6
    map_mb, file_mb = voxels.memory_bytes * 1e-6 - spilled_mb, shelf.file_bytes * 1e-6
    counts = (voxels.block_count, voxels.blocks.count, memory.cold_regions)
    cold_bytes = 512.0 * memory.cold_blocks
    compression = cold_bytes / max(memory.memory_bytes, 1)
    return_ms = max(_insert(voxels, decay, sent) for sent in _scans(stream))
    return Side(
        rss_growth_mb=round(at_end, 1),
        peak_growth_mb=round(max(*grown, at_end), 1),
        scratch_mb=round(_drop_scratch(voxels), 1),
        map_mb=round(map_mb, 1),
        spilled_mb=round(spilled_mb, 1),
        file_mb=round(file_mb, 1),
        blocks=counts[0],
        warm_blocks=counts[1],
        cold_regions=counts[2],
        compression=round(compression, 2),
        move_ms_p50=round(float(np.median(moves)), 2),
        move_ms_max=round(float(moves.max()), 2),
        insert_ms_p50=round(float(np.median(insert_ms)), 2),
        return_ms=round(return_ms, 1),
        forgotten_blocks=memory.forgotten_blocks,
        digest=_digest(voxels),
    )


class _Watch:
    """Takes the CPU time of each move of regions."""

    def __init__(self, voxels: VoxelMap) -> None:
        self.moves_ms: list[float] = []
        self._work = voxels.memory.before_scan
        voxels.memory.before_scan = self._timed  # type: ignore[method-assign]

    def _timed(self, here: NDArray[np.int64], reach: int) -> None:
        started = time.process_time()
        self._work(here, reach)
        self.moves_ms.append(1e3 * (time.process_time() - started))


def _insert(voxels: VoxelMap, decay: Decay, sent: _Sent) -> float:
    """CPU ms of one scan."""
    R, p = np.frombuffer(sent.R).reshape(3, 3), np.frombuffer(sent.p)
    points, misses = (np.frombuffer(data, np.float32).reshape(-1, 3) for data in (sent.points, sent.misses))
    started = time.process_time()
    voxels.insert(points, R_odom_body=R, p_odom=p, origin_odom=p, miss_dirs_body=misses, stamp_ns=sent.stamp_ns)
    decay.after_scan(voxels, sent.stamp_ns)
    return 1e3 * (time.process_time() - started)


def _warm_up() -> None:
    """Compile everything, and let go of it."""
    forest = make_long_forest(10.0, seed=0)
    config = VoxelMapConfig(max_range_m=6.0, miss_clear_range_m=6.0, memory=MemoryConfig(keep_m=0.0))
    voxels, decay = VoxelMap(config, decays=True, shelf=FileShelf()), Decay(DecayConfig())
    for number in range(6):
        scan = look_from(forest, 8.0 * (number % 3), number)
        voxels.insert(
            scan.points_body, R_odom_body=scan.R_odom_body, p_odom=scan.p_odom, origin_odom=scan.p_odom,
            miss_dirs_body=scan.miss_dirs_body,
        )  # fmt: skip
        decay.after_scan(voxels, number * 10**9)
    _digest(voxels)


def _drop_scratch(voxels: VoxelMap) -> float:
    """What the process shrinks by when the ray grid goes; the map takes no scan after this."""
    gc.collect()
    before = rss_mb()
    del voxels._rays
    gc.collect()
    return before - rss_mb()


def _digest(voxels: VoxelMap) -> str:
    total = hashlib.sha256()
    for part in voxels.memory.parts():
        for array in part.values():
            total.update(array.tobytes())
    return total.hexdigest()


def _scans(stream: IO[bytes]) -> Any:
    while data := _read(stream):
        yield msgspec.msgpack.decode(data, type=_Sent)


def _read(stream: IO[bytes]) -> bytes:
    return stream.read(_SIZE.unpack(stream.read(_SIZE.size))[0])


def rss_mb() -> float:
    """Memory of this process that is in RAM, 10^6 bytes."""
    lines = Path("/proc/self/status").read_text().split("\n")
    return next(1024e-6 * int(line.split()[1]) for line in lines if line.startswith("VmRSS"))


if __name__ == "__main__":
    main()
