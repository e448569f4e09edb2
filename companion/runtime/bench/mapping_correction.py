"""What it costs that the map follows corrected poses: a kilometre is flown, then the loop closes 2 m off.

figures = correction_figures(length_m=1000.0, resolution_m=0.2)

The map is that of a flight: with decay, and with a shelf for far blocks and for what corrections need.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from itertools import count

import numpy as np

from companion.core.geometry import quaternion_from_rotation
from companion.core.messages import Array, PoseCorrections
from companion.mapping.correction import Corrected, warm_correction
from companion.mapping.decay import Decay, DecayConfig
from companion.mapping.follow import FollowConfig, MapFollower
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig
from companion.runtime.bench.mapping_kilometre import LongScan, fly_along, look_from, make_long_forest
from companion.runtime.bench.mapping_memory import STEP_M
from companion.runtime.bench.mapping_peers import cpu_ms
from companion.runtime.file_shelf import FileShelf

_PERIOD_NS = 10**8  # of scans
_OFF_M = np.array([0.0, 2.0, 0.2])  # error of the end against the start, grown evenly


@dataclass(slots=True)
class _Flight:
    """A map, what follows corrections for it, and CPU ms per scan of both."""

    voxels: VoxelMap
    follower: MapFollower
    decay: Decay
    insert_ms: list[float] = field(default_factory=list)
    follow_ms: list[float] = field(default_factory=list)
    poses: list[tuple[Array, Array]] = field(default_factory=list)  # position (3,), quaternion (4,)

    def take(self, scan: LongScan) -> Corrected | None:
        """One scan; what a correction did that ended with it."""
        stamp_ns, done = len(self.insert_ms) * _PERIOD_NS, []
        p, q = scan.p_odom, quaternion_from_rotation(scan.R_odom_body)
        self.poses.append((p, q))
        self.insert_ms.append(cpu_ms(partial(self._insert, scan, stamp_ns)))
        self.follow_ms.append(cpu_ms(lambda: done.append(self.follower.after_scan(stamp_ns, p, q))))
        return done[0]

    def corrected(self) -> PoseCorrections:
        """The poses so far, less an error that grew evenly along the way."""
        p, q = (np.array(part) for part in zip(*self.poses, strict=True))
        stamps_ns = np.arange(len(p)) * _PERIOD_NS
        off = np.linspace(0.0, 1.0, len(p))[:, None] * _OFF_M
        return PoseCorrections(stamp_ns=int(stamps_ns[-1]), stamps_ns=stamps_ns, p_odom=p - off, q_odom_body=q)

    def _insert(self, scan: LongScan, stamp_ns: int) -> None:
        self.voxels.insert(
            scan.points_body,
            R_odom_body=scan.R_odom_body,
            p_odom=scan.p_odom,
            origin_odom=scan.p_odom,
            miss_dirs_body=scan.miss_dirs_body,
            stamp_ns=stamp_ns,
            watch=self.follower.watch,
        )
        self.decay.after_scan(self.voxels, stamp_ns)


def correction_figures(*, length_m: float = 1000.0, resolution_m: float = 0.2, seed: int = 1) -> dict[str, float]:
    """CPU of the correction in all and per scan beside which it runs, and of following and inserting without one."""
    config = VoxelMapConfig(resolution_m=resolution_m)
    warm_correction(config)
    voxels = VoxelMap(config, decays=True, shelf=FileShelf())
    flight = _Flight(voxels, MapFollower(FollowConfig(), voxels), Decay(DecayConfig()))
    forest = make_long_forest(length_m, seed=seed)
    for scan in fly_along(forest, step_m=STEP_M):
        flight.take(scan)
    flown = len(flight.insert_ms)
    flight.follower.take(flight.corrected())
    beside = (look_from(forest, length_m, number) for number in count(flown))
    done = next(done for done in map(flight.take, beside) if done)
    steps = np.array(flight.follow_ms[flown:])
    return {
        "correction_s": 1e-3 * float(steps.sum()),
        "step_ms_p50": float(np.median(steps)),
        "step_ms_max": float(steps.max()),
        "steps": float(len(steps)),
        "moved": float(done.moved),
        "stayed": float(done.stayed),
        "blocks": float(done.blocks),
        "follow_ms_p50": float(np.median(flight.follow_ms[:flown])),
        "insert_ms_p50": float(np.median(flight.insert_ms[:flown])),
        "insert_beside_ms_p50": float(np.median(flight.insert_ms[flown:])),
        "length_m": length_m,
    }
