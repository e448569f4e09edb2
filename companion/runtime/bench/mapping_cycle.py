"""A whole cycle of mapping beside a copy of memory: insertion, snapshot, segment checks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from companion.core.messages import Array
from companion.mapping.distance_field import DistanceField, FieldConfig
from companion.mapping.snapshot import segment_free
from companion.runtime.bench.mapping_field import filled
from companion.runtime.bench.mapping_insert import RANGE_M
from companion.runtime.bench.mapping_peers import OctoMap, alternate, copy_gb_s, cpu_ms
from companion.runtime.bench.mapping_scans import Scan

_CELL_M = 0.2
_SEGMENTS, _RADIUS_M = 10_000, 0.35


def time_cycle(scans: list[Scan], *, rounds: int) -> dict[str, float]:
    """What the stack does for a scan, beside OctoMap's insertion alone.

    The yardstick is copying memory in the same run: `ours_in_copied_mb` could be copied in our time.
    """
    *before, scan = scans
    checks = segments(scan.p_odom)
    field, best, peer_ms = DistanceField(FieldConfig(), resolution_m=_CELL_M), dict[str, float](), np.inf
    for _ in range(rounds):
        tree = OctoMap(_CELL_M, RANGE_M)
        for earlier in before:
            tree.insertion(earlier)()
        peer_ms = min(peer_ms, cpu_ms(tree.insertion(scan)))
        voxels = filled(before)
        taken = {"insert_ms": cpu_ms(partial(scan.into, voxels))}
        snapshot = field.around(voxels, scan.p_odom, 0)
        works: dict[str, Callable[[], object]] = {
            "snapshot_ms": partial(field.around, voxels, scan.p_odom, 0),
            "segments_ms": partial(segment_free, snapshot, *checks, _RADIUS_M),
        }
        taken |= alternate(works, rounds=1)
        best = {name: min(ms, best.get(name, np.inf)) for name, ms in taken.items()}
    ours_ms, gb_s = sum(best.values()), copy_gb_s()
    yardstick = {"copy_gb_s": gb_s, "ours_in_copied_mb": gb_s * ours_ms, "segments": float(_SEGMENTS)}
    return {"ours_ms": ours_ms, "peer_ms": peer_ms, **best, **yardstick, "rounds": float(rounds)}


def segments(center_odom: Array) -> tuple[Array, Array]:
    """Ends (K, 3) of segments of up to 4 m around a place, m."""
    rng = np.random.default_rng(5)
    starts = center_odom + rng.uniform((-15, -15, -2), (15, 15, 2), (_SEGMENTS, 3))
    return starts, starts + rng.uniform(-2.3, 2.3, (_SEGMENTS, 3))
