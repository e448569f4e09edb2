"""Mapping: registered scans in, local maps out."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from companion.core.geometry import rotation_from_quaternion
from companion.core.messages import Array, Goal, MapStatus, ObstacleTracks, PoseCorrections, RegisteredScan, Why
from companion.core.node import Node, Outputs, on
from companion.core.rig import Rig
from companion.core.topics import (
    CORRECTIONS,
    GOAL,
    LOCAL_MAP,
    MAP_DELTA,
    MAP_FULL,
    MAP_STATUS,
    OBSTACLE_TRACKS,
    OCCUPIED,
    REGISTERED,
    WHY,
)
from companion.mapping.decay import Decay, DecayConfig
from companion.mapping.distance_field import DistanceField, FieldConfig
from companion.mapping.follow import FollowConfig, MapFollower
from companion.mapping.free_volume import cells_around
from companion.mapping.landmark_node import LandmarkConfig
from companion.mapping.share import MapShare, ShareConfig
from companion.mapping.shelf import Shelf
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig
from companion.mapping.warm_up import warm_up

_Metres = Annotated[float, msgspec.Meta(gt=0.0, le=10.0)]


class MappingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The map, the field around the vehicle, and what is free since the vehicle is there."""

    voxels: VoxelMapConfig = VoxelMapConfig()
    field: FieldConfig = FieldConfig()
    decay: DecayConfig = DecayConfig()
    follow: FollowConfig = FollowConfig()
    share: ShareConfig = ShareConfig()
    landmarks: LandmarkConfig = LandmarkConfig()  # of LandmarkNode
    map_every: Annotated[int, msgspec.Meta(ge=1)] = 2  # scans per local map
    own_radius_m: _Metres = 0.35  # returns nearer to the body's origin are the vehicle itself
    start_free_radius_m: _Metres = 0.7  # sphere that is free at the first scan: nothing touches the rotors
    start_free_height_m: Annotated[float, msgspec.Meta(ge=0.0, le=10.0)] = 3.0
    """Column of that radius above the start that is free, too: the LiDAR cannot look straight up,
    so the take-off stands on the word of whoever chose the place. 0: trust the LiDAR alone."""


class MappingNode(Node):
    """Takes in every registered scan; publishes the local map after every `map_every`-th, the rest as `share` has it.

    `voxels` is the map, for saving at the end of a flight. `skipped_pose` and `skipped_stamp`
    count scans that were left out: pose not finite, stamp not newer than the last.
    """

    publishes = (LOCAL_MAP, MAP_STATUS, OCCUPIED, MAP_DELTA, MAP_FULL, WHY)

    def __init__(self, config: MappingConfig, rig: Rig, *, hull_radius_m: float, shelf: Shelf | None = None) -> None:
        """`shelf`: where blocks of the map may lie that are far away."""
        self.config = config
        self.rig = rig
        self.hull_radius_m = hull_radius_m  # a sphere that is free at each scan: the vehicle fills it
        self.voxels = VoxelMap(config.voxels, decays=config.decay.on, shelf=shelf)
        self.scans = self.skipped_pose = self.skipped_stamp = 0
        self._field = DistanceField(config.field, resolution_m=config.voxels.resolution_m)
        self.follower = MapFollower(config.follow, self.voxels)
        self._decay = Decay(config.decay)
        self._share = MapShare(config.share)
        self._newest_ns = -1
        self._unknown = False  # was a goal given that takes unknown space for blocked?
        self._said: list[str] = []
        warm_up(self.voxels)
        self._field.around(self.voxels, np.zeros(3), 0)

    @on(REGISTERED)
    def insert(self, scan: RegisteredScan) -> Outputs:
        """Take in one scan."""
        if not _usable(scan):
            self.skipped_pose += 1
            return
        if scan.stamp_ns <= self._newest_ns:
            self.skipped_stamp += 1
            return
        self._newest_ns = scan.stamp_ns
        R_odom_body = rotation_from_quaternion(scan.q_odom_body)
        self.voxels.insert(
            scan.points_body,
            R_odom_body=R_odom_body,
            p_odom=scan.p_odom,
            origin_odom=scan.p_odom + R_odom_body @ scan.origin_body,
            miss_dirs_body=scan.miss_dirs_body,
            free_odom=self._filled_by_vehicle(scan.p_odom),
            own_radius_m=self.config.own_radius_m,
            stamp_ns=scan.stamp_ns,
            watch=self.follower.watch,
        )
        self._decay.after_scan(self.voxels, scan.stamp_ns)
        yield from self._follow(scan)
        yield from self._tell_of_shelf(scan.stamp_ns)
        if self.scans % self.config.map_every == 0:
            yield LOCAL_MAP(self._field.around(self.voxels, scan.p_odom, scan.stamp_ns, unknown=self._unknown))
            yield MAP_STATUS(self._status(scan.stamp_ns))
        self.scans += 1
        yield from self._share.after_scan(self.voxels, scan.p_odom, stamp_ns=scan.stamp_ns)

    @on(OBSTACLE_TRACKS)
    def walked(self, tracks: ObstacleTracks) -> None:
        """What stands where something moved is its ghost, unless it was proven before."""
        self._decay.take(tracks)

    @on(CORRECTIONS)
    def correct(self, corrections: PoseCorrections) -> None:
        """Let the map follow, a step with each scan from now on."""
        self.follower.take(corrections)

    @on(GOAL)
    def serve(self, goal: Goal) -> None:
        """From the first goal on that takes unknown space for blocked, local maps say how far that is."""
        self._unknown = self._unknown or goal.limits.unknown == "blocked"

    def _follow(self, scan: RegisteredScan) -> Outputs:
        done = self.follower.after_scan(scan.stamp_ns, scan.p_odom, scan.q_odom_body)
        if done:
            what = f"corrected the map: {done.moved} of {done.moved + done.stayed} stretches of the flight moved"
            yield WHY(Why(stamp_ns=scan.stamp_ns, node="mapping", what=what, because="past poses were corrected"))

    def _tell_of_shelf(self, stamp_ns: int) -> Outputs:
        """Once: that far blocks stay in memory after all, that the map cannot be corrected any more."""
        refusal, failure = self.voxels.memory.cold.shelves.refusal, self.follower.failure
        for what, why in (("keeps far blocks of the map in memory", refusal), ("corrects the map no more", failure)):
            if why and what not in self._said:
                self._said.append(what)
                yield WHY(Why(stamp_ns=stamp_ns, node="mapping", what=what, because=why))

    def _status(self, stamp_ns: int) -> MapStatus:
        voxels = self.voxels
        return MapStatus(
            stamp_ns=stamp_ns,
            scans=self.scans + 1,
            blocks=voxels.block_count,
            cold_blocks=voxels.memory.cold_blocks,
            forgotten_blocks=voxels.memory.forgotten_blocks,
            memory_bytes=voxels.memory_bytes,
        )

    def _filled_by_vehicle(self, p_odom: Array) -> Array:
        """Centres (K, 3) of the cells that are free because the vehicle is, or starts, there."""
        cell_m = self.voxels.resolution_m
        if self.scans > 0:
            return cells_around(p_odom, radius_m=self.hull_radius_m, height_m=0.0, cell_m=cell_m)
        radius_m = max(self.hull_radius_m, self.config.start_free_radius_m)
        return cells_around(p_odom, radius_m=radius_m, height_m=self.config.start_free_height_m, cell_m=cell_m)


def _usable(scan: RegisteredScan) -> bool:
    """Finite, near enough to have float precision, and with a unit quaternion."""
    parts = np.concatenate([scan.p_odom, scan.origin_body])
    return bool(np.all(np.abs(parts) < 1e4) and abs(float(scan.q_odom_body @ scan.q_odom_body) - 1.0) < 1e-3)
