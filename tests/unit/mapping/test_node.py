"""The mapping node: what is free without being seen, when it publishes, what it leaves out."""

import dataclasses
import math

import msgspec
import numpy as np
import pytest

from companion.core.geometry import quaternion_from_yaw
from companion.core.messages import Goal, Limits, RegisteredScan, freeze
from companion.core.rig import Rig
from companion.core.topics import GOAL, LOCAL_MAP, MAP_STATUS, REGISTERED, WHY
from companion.mapping.distance_field import FieldConfig
from companion.mapping.free_volume import cells_around
from companion.mapping.memory import MemoryConfig
from companion.mapping.node import MappingConfig, MappingNode
from companion.mapping.voxel_map import VoxelMapConfig

NEARBY = MappingConfig(
    voxels=VoxelMapConfig(max_range_m=10.0, miss_clear_range_m=5.0), field=FieldConfig(size_m=(8.0, 8.0, 6.0))
)


def scan(stamp_ns, points=((5.0, 0.0, 0.0),), *, p=(0.0, 0.0, 0.3), yaw=0.0, misses=(), origin=(0.08, 0.0, 0.06)):
    return freeze(
        RegisteredScan(
            stamp_ns=stamp_ns,
            points_body=np.array(points, np.float32).reshape(-1, 3),
            miss_dirs_body=np.array(misses, np.float32).reshape(-1, 3),
            origin_body=np.array(origin),
            p_odom=np.array(p, np.float64),
            q_odom_body=quaternion_from_yaw(yaw),
        )
    )


def feed(node, message):
    """The maps that the node publishes because of one scan; each comes with its status."""
    outputs = list(node.handle(REGISTERED, message))
    maps = [o.message for o in outputs if o.topic is LOCAL_MAP]
    statuses = [o.message for o in outputs if o.topic is MAP_STATUS]
    assert [(s.stamp_ns, s.scans) for s in statuses] == [(m.stamp_ns, node.scans) for m in maps]
    return maps


def test_every_second_scan_gives_a_local_map_from_the_first_on():
    node = MappingNode(NEARBY, Rig(), hull_radius_m=0.35)
    maps = [feed(node, scan(k)) for k in range(1, 7)]
    assert [len(m) for m in maps] == [1, 0, 1, 0, 1, 0]
    assert [m[0].stamp_ns for m in maps[::2]] == [1, 3, 5]
    assert not maps[0][0].distance_m.flags.writeable
    assert node.scans == 6


def test_points_land_where_the_pose_puts_them():
    node = MappingNode(NEARBY, Rig(), hull_radius_m=0.35)
    feed(node, scan(1, [(3.0, 0.1, 0.55)], p=(1.0, 2.1, 0.3), yaw=math.pi / 2, origin=(0.0, 0.1, 0.05)))
    assert node.voxels.classify(np.array([[0.9, 5.1, 0.85], [0.9, 3.5, 0.55]])).tolist() == [2, 1]
    assert len(node.voxels.occupied_centers()) == 1


def goal(unknown):
    limits = Limits(
        speed=3.0,
        climb=1.0,
        accel=3.0,
        jerk=20.0,
        yaw_rate=1.5,
        clearance=0.4,
        unknown=unknown,
        agl_min=1.0,
        agl_max=6.0,
    )
    return Goal(
        stamp_ns=0,
        id=1,
        kind="fly",
        p_odom=np.zeros(3),
        agl_m=np.nan,
        radius_m=0.3,
        fly_through=False,
        next_p_odom=np.empty((0, 3)),
        yaw=np.nan,
        if_blocked="fail",
        limits=limits,
    )


def test_how_far_unknown_space_is_is_told_once_a_goal_needs_it():
    node = MappingNode(msgspec.structs.replace(NEARBY, map_every=1), Rig(), hull_radius_m=0.35)
    sizes = []
    for k, unknown in enumerate(("stop_before", "blocked", "optimistic")):
        list(node.handle(GOAL, goal(unknown)))
        (local,) = feed(node, scan(k, [(3.0, 0.0, 1.0)]))
        sizes.append(local.unknown_distance_m.shape)
    assert sizes == [(0, 0, 0), local.state.shape, local.state.shape]


def test_the_start_is_free_where_nothing_was_hit():
    node = MappingNode(NEARBY, Rig(), hull_radius_m=0.35)
    list(node.handle(GOAL, goal("blocked")))
    branch = (0.05, 0.05, 1.52)
    (local,) = feed(node, scan(1, [branch]))
    p = np.array([0.0, 0.0, 0.3])
    assert (
        node.voxels.classify(p + np.array([[0, 0, -0.6], [0.6, 0, 0], [0, -0.5, 0.4], [0, 0.4, 2.7]])).tolist()
        == [1] * 4
    )
    assert node.voxels.classify(p + np.array([[0, 0, -0.9], [0.9, 0, 0], [0, 0.4, 3.2]])).tolist() == [0] * 3
    assert node.voxels.classify(p + np.array([branch])) == [2]
    here = np.floor((p - local.origin_odom) / 0.2).astype(int)
    assert local.state[tuple(here)] == 1
    assert local.unknown_distance_m[tuple(here)] >= 0.7 - 0.15 - 0.1  # the centre is off by up to that


def test_only_the_start_has_a_column_and_the_hull_frees_what_it_fills():
    node = MappingNode(NEARBY, Rig(), hull_radius_m=0.35)
    feed(node, scan(1))
    feed(node, scan(2, p=(0.0, 6.0, 2.1)))
    offsets = np.array([[0, 0, 0], [0, 0.25, 0], [0, 0, 0.25], [0, -0.6, 0], [0, 0, 1.0]])
    assert node.voxels.classify(np.array([0.0, 6.0, 2.1]) + offsets).tolist() == [1, 1, 1, 0, 0]


def test_a_start_without_column_trusts_the_lidar_alone():
    config = MappingConfig(voxels=NEARBY.voxels, field=NEARBY.field, start_free_height_m=0.0)
    node = MappingNode(config, Rig(), hull_radius_m=0.35)
    feed(node, scan(1))
    assert node.voxels.classify(np.array([[0.1, 0.1, 0.7], [0.1, 0.1, 1.5]])).tolist() == [1, 0]


def test_returns_from_the_own_body_are_no_obstacles():
    node = MappingNode(NEARBY, Rig(), hull_radius_m=0.35)
    feed(node, scan(1, [(0.2, 0.1, 0.0), (-0.3, 0.0, 0.05), (2.0, 0.0, 0.0)]))
    assert len(node.voxels.occupied_centers()) == 1


def test_misses_clear():
    node = MappingNode(NEARBY, Rig(), hull_radius_m=0.35)
    feed(node, scan(1, [], misses=[(1.0, 0.0, 0.0)]))
    assert node.voxels.classify(np.array([[4.0, 0.0, 0.36], [6.0, 0.0, 0.36]])).tolist() == [1, 0]


@pytest.mark.parametrize(
    "change",
    [
        {"p_odom": np.array([0.0, np.nan, 0.0])},
        {"p_odom": np.array([0.0, np.inf, 0.0])},
        {"q_odom_body": np.array([np.nan, 0.0, 0.0, 1.0])},
        {"q_odom_body": np.zeros(4)},
        {"origin_body": np.array([0.0, 0.0, np.nan])},
    ],
)
def test_scans_without_a_usable_pose_are_left_out_and_counted(change):
    node = MappingNode(NEARBY, Rig(), hull_radius_m=0.35)
    assert feed(node, dataclasses.replace(scan(5), **change)) == []
    assert (node.skipped_pose, node.scans, node.voxels.block_count) == (1, 0, 0)
    assert len(feed(node, scan(5))) == 1


def test_scans_out_of_order_are_left_out_and_counted():
    node = MappingNode(NEARBY, Rig(), hull_radius_m=0.35)
    feed(node, scan(5))
    before = node.voxels.to_arrays()["log_odds"].tobytes()
    for stamp_ns in (5, 4):
        assert feed(node, scan(stamp_ns, [(0.0, 4.0, 0.0)])) == []
    assert node.skipped_stamp == 2
    assert node.voxels.to_arrays()["log_odds"].tobytes() == before


def test_two_nodes_fed_alike_publish_the_same_bytes():
    rng = np.random.default_rng(8)
    clouds = [rng.normal(size=(500, 3)) * 3 for _ in range(4)]
    runs = []
    for _ in range(2):
        node = MappingNode(NEARBY, Rig(), hull_radius_m=0.35)
        list(node.handle(GOAL, goal("blocked")))
        maps = [m for k, c in enumerate(clouds) for m in feed(node, scan(k, c, p=(0.3 * k, 0, 1), misses=c[:50]))]
        runs.append(b"".join(m.distance_m.tobytes() + m.unknown_distance_m.tobytes() for m in maps))
    assert runs[0] == runs[1]


def test_cells_around_are_those_whose_centre_is_inside():
    p = np.array([0.37, -1.24, 2.05])
    cells = cells_around(p, radius_m=0.5, height_m=2.0, cell_m=0.2)
    axes = [np.round(p / 0.2)[i] * 0.2 + np.arange(-20, 20) * 0.2 + 0.1 for i in range(3)]
    every = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    d = every - p
    flat = np.hypot(d[:, 0], d[:, 1])
    inside = (np.linalg.norm(d, axis=1) <= 0.5) | ((flat <= 0.5) & (d[:, 2] >= 0) & (d[:, 2] <= 2.0))
    inside |= np.all(np.abs(d) <= 0.1, axis=1)
    assert sorted(map(tuple, np.round(cells, 6).tolist())) == sorted(map(tuple, np.round(every[inside], 6).tolist()))
    assert len(cells_around(p, radius_m=0.01, height_m=0.0, cell_m=0.2)) == 1


def test_the_status_tells_what_is_compressed_and_what_the_budget_cost():
    """A walk of 80 m with 16 regions moved per scan; the second map may hold hardly more than is in reach."""
    told = []
    for budget_mb in (1000.0, 0.1):
        memory = MemoryConfig(keep_m=0.0, budget_mb=budget_mb)
        voxels = VoxelMapConfig(max_range_m=5.0, miss_clear_range_m=5.0, memory=memory)
        node = MappingNode(msgspec.structs.replace(NEARBY, voxels=voxels, map_every=1), Rig(), hull_radius_m=0.35)
        for k in range(40):
            outputs = list(node.handle(REGISTERED, scan(k + 1, p=(2.0 * k, 0.0, 0.3))))
        (status,) = [o.message for o in outputs if o.topic is MAP_STATUS]
        assert status.blocks == node.voxels.block_count == node.voxels.blocks.count + status.cold_blocks
        assert status.memory_bytes == node.voxels.memory_bytes
        told.append(status)
    roomy, tight = told
    assert roomy.cold_blocks > 0
    assert roomy.forgotten_blocks == 0
    assert tight.cold_blocks == 0
    assert tight.blocks + tight.forgotten_blocks == roomy.blocks


class FullDisk:
    def put(self, data):
        raise OSError(28, "No space left on device")


def test_a_disk_that_is_full_costs_memory_and_is_told_once():
    near = msgspec.structs.replace(NEARBY.voxels, memory=MemoryConfig(keep_m=0.0))
    config = msgspec.structs.replace(NEARBY, voxels=near)
    node, whys = MappingNode(config, Rig(), hull_radius_m=0.35, shelf=FullDisk()), []
    for k in range(30):
        outputs = node.handle(REGISTERED, scan(10**8 * (k + 1), p=(2.0 * k, 0.0, 0.3)))
        whys += [o.message for o in outputs if o.topic is WHY]
    assert node.voxels.memory.cold_blocks > 0 == node.voxels.memory.spilled_bytes
    assert [w.what for w in whys] == ["keeps far blocks of the map in memory"]
    assert "No space left" in whys[0].because
