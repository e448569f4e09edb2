"""What walkers leave in the map of a forest, and what decay costs the branches: pytest -m slow -s on this file."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from companion.core.messages import RegisteredScan
from companion.core.rig import Rig
from companion.core.topics import LOCAL_MAP, OBSTACLE_TRACKS, REGISTERED
from companion.estimation.tracks.node import ObstacleTracksConfig, ObstacleTracksNode
from companion.mapping.decay import Decay, DecayConfig
from companion.mapping.node import MappingConfig, MappingNode
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig
from sim.sensors.caster import Caster
from sim.sensors.lidar import Lidar, LidarConfig
from sim.world import load_world
from sim.world.mesh import GROUND
from sim.world.walkers import NOBODY

SCAN_NS, SCANS, CELL_M = 100_000_000, 300, 0.2
WITHIN_M = 10.0
RIG = Rig()
MAPS = {"off": DecayConfig(on=False), "marks": DecayConfig(), "still": DecayConfig(on=False)}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_walkers_leave_few_ghosts_and_branches_stay(seed):
    """30 s to and fro at 0.8 m/s among the six walkers of world `moving`; `still` has no walkers."""
    world = load_world("moving", seed=seed)
    maps = {name: (VoxelMap(VoxelMapConfig(), decays=True), Decay(config)) for name, config in MAPS.items()}
    flown, ages = Flown(), {"off": Ages(), "marks": Ages(), "flown": Ages()}
    for k, p, scans in flight(world):
        for name, (voxels, decay) in maps.items():
            take_in(voxels, scans["still" if name == "still" else "walked"], p, k)
            decay.after_scan(voxels, k * SCAN_NS)
        flown.take_in(scans["walked"], p, k)
        for name, log in ages.items():
            voxels = flown.voxels if name == "flown" else maps[name][0]
            log.look(k, p, world.walkers, voxels, maps["still"][0])
    old = {name: np.mean(log.all() > 2.0) for name, log in ages.items()}
    branches = branch_cells(world, maps["still"][0])
    recall = {name: np.mean(maps[name][0].classify(branches) == 2) for name in ("off", "marks")}
    recall["flown"] = np.mean(flown.voxels.classify(branches) == 2)
    print(f"seed {seed}: older than 2 s {old}, branch recall {recall}, {len(branches)} voxels")
    assert old["off"] > 0.2
    assert old["marks"] < 0.05
    assert old["flown"] < 0.025
    assert recall["flown"] >= recall["off"] - 0.01


class Flown:
    """The map as it flies: tracks tell it where something moved."""

    def __init__(self):
        self.mapping = MappingNode(MappingConfig(), RIG, hull_radius_m=0.35)
        self.tracks = ObstacleTracksNode(ObstacleTracksConfig())

    @property
    def voxels(self):
        return self.mapping.voxels

    def take_in(self, scan, p, k):
        points, misses = in_body(scan)
        registered = RegisteredScan(
            stamp_ns=k * SCAN_NS, points_body=points, miss_dirs_body=misses, origin_body=RIG.lidar.p_body,
            p_odom=p, q_odom_body=np.array([1.0, 0.0, 0.0, 0.0]),
        )  # fmt: skip
        for out in self.tracks.handle(REGISTERED, registered):
            list(self.mapping.handle(OBSTACLE_TRACKS, out.message))
        for out in self.mapping.handle(REGISTERED, registered):
            if out.topic is LOCAL_MAP:
                list(self.tracks.handle(LOCAL_MAP, out.message))


def flight(world):
    """(number, position, scans with and without walkers), scan by scan."""
    caster = Caster(world.mesh)
    walkers = {"walked": world.walkers, "still": NOBODY}
    lidars = {
        name: Lidar(LidarConfig(), RIG.lidar, caster, world.mesh, 0, walkers=who) for name, who in walkers.items()
    }
    for k in range(1, SCANS + 1):
        along_m = 0.08 * (k % (SCANS // 2))
        p = np.array([along_m - 6.0 if k <= SCANS // 2 else 6.0 - along_m, 0.0, 2.5])
        poses = np.tile(p, (2, 1)), np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
        yield k, p, {name: lidar.scan(*poses, stamp_ns=k * SCAN_NS, counter=k) for name, lidar in lidars.items()}


def take_in(voxels, scan, p, k):
    points, misses = in_body(scan)
    voxels.insert(
        points, R_odom_body=np.eye(3), p_odom=p, origin_odom=p + RIG.lidar.p_body,
        miss_dirs_body=misses, stamp_ns=k * SCAN_NS,
    )  # fmt: skip


def in_body(scan):
    """Returns and directions without one, float32."""
    R = RIG.lidar.R_body_sensor
    points, misses = ((v @ R.T).astype(np.float32) for v in (scan.points_sensor, scan.miss_dirs_sensor))
    return points + RIG.lidar.p_body.astype(np.float32), misses


class Ages:
    """For how long voxels stay occupied after a walker has left them."""

    def __init__(self):
        self.left = {}  # voxel -> number of the scan in which a walker was last in it
        self.lives = []

    def look(self, k, p, walkers, voxels, still):
        feet = np.array([walkers.feet(k * SCAN_NS - age) for age in (0, SCAN_NS // 2, SCAN_NS)])
        for key, occupied, inside in self._now(voxels, feet):
            if inside and occupied:
                self.left[key] = k
            elif inside:
                del self.left[key]
            elif not occupied:
                self.lives.append(0.1 * (k - self.left.pop(key)))
        cells = np.concatenate([around(foot) for foot in feet[0]])
        new = covered(cells, feet, 0.5) & (voxels.classify(cells) == 2) & (still.classify(cells) != 2)
        new &= np.linalg.norm(cells - p, axis=1) < WITHIN_M
        self.left |= {tuple(cell): k for cell in cells[new].round(3)}

    def _now(self, voxels, feet):
        keys = list(self.left)
        cells = np.array(keys).reshape(-1, 3)
        return zip(keys, voxels.classify(cells) == 2, covered(cells, feet, 0.55), strict=True)

    def all(self):
        """With those that still stand and are old by now."""
        return np.array(self.lives + [0.1 * (SCANS - k) for k in self.left.values() if k < SCANS - 20])


def around(foot):
    """Centres of the voxels that a walker, 0.35 m thick and 2.8 m tall, may fill; not the ground's."""
    side, up = CELL_M * np.arange(-3, 4), CELL_M * np.arange(1, 14)
    x, y, z = ((np.floor(c / CELL_M) + 0.5) * CELL_M for c in foot)
    return np.stack(np.meshgrid(x + side, y + side, z + up, indexing="ij"), -1).reshape(-1, 3)


def covered(cells, feet, radius_m):
    away = [np.hypot(cells[:, None, 0] - f[None, :, 0], cells[:, None, 1] - f[None, :, 1]) for f in feet]
    return np.any([np.any(a < radius_m, axis=1) for a in away], axis=0)


def branch_cells(world, still):
    """Occupied voxels near the way that hold a branch, and no trunk."""
    mesh = world.mesh
    thin = (mesh.widths_m < 0.05) & (mesh.classes != GROUND)
    thick = mesh.vertices[mesh.triangles[~thin]].reshape(-1, 3)
    cells = still.occupied_centers()
    cells = cells[(np.abs(cells[:, 1]) < 8.0) & (np.abs(cells[:, 0]) < 12.0)]
    to_thin = cKDTree(mesh.vertices[mesh.triangles[thin]].reshape(-1, 3)).query(cells)[0]
    return cells[(to_thin < 0.15) & (cKDTree(thick).query(cells)[0] > 0.4)]
