"""The map's topics on a bus: who comes late gets the whole map and the deltas since, and follows from there."""

from threading import Lock

import numpy as np

from companion.core import topics
from companion.mapping.mirror import MapMirror
from companion.mapping.sensor_model import UNKNOWN
from companion.mapping.share import MapShare, ShareConfig
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig
from companion.runtime.bus.attach import BusOutlet, Hearing


class Receiver:
    """A mirror behind a bus."""

    def __init__(self):
        self._lock = Lock()  # each subscription calls from a thread of its own
        self.mirror, self.clouds = MapMirror(), []

    def receive(self, topic, message, *, decode):
        with self._lock:
            if topic is topics.OCCUPIED:
                self.clouds.append(decode(message))
            else:
                self.mirror.take(decode(message))


def known(voxels):
    blocks = voxels.blocks
    order = np.lexsort(blocks.xyz[: blocks.count].T)
    levels = blocks.log_odds[order]
    states = np.where(levels == UNKNOWN, 0, np.where(levels >= 0, 2, 1)).astype(np.uint8)
    there = states.any(axis=1)
    return blocks.xyz[order[there]].tobytes() + states[there].tobytes()


def test_a_late_joiner_has_the_map_and_follows_it(pair, eventually):
    first, second = pair
    told = [topics.OCCUPIED, topics.MAP_DELTA, topics.MAP_FULL]
    outlet = BusOutlet(first, {"MappingNode": told}, vehicle="drone7")
    share = MapShare(ShareConfig(occupied_every=1, delta_every=1, full_every=20, full_blocks_per_scan=60))
    voxels, rng = VoxelMap(VoxelMapConfig(max_range_m=6.0, miss_clear_range_m=4.0)), np.random.default_rng(0)
    said = []

    def fly(scans):
        for _ in range(scans):
            origin = rng.uniform(-5, 5, 3)
            points = rng.normal(size=(20, 3)).astype(np.float32) * 3
            voxels.insert(points, R_odom_body=np.eye(3), p_odom=origin, origin_odom=origin)
            for output in share.after_scan(voxels, origin, stamp_ns=len(said)):
                outlet.publish(output.topic, output.message, len(said))
                said.append(output)

    fly(35)
    fulls = [o.message for o in said if o.topic is topics.MAP_FULL]
    assert fulls and fulls[-1].version_to < voxels.version  # deltas have followed it
    late = Receiver()
    Hearing(second, told, late, listener="late", vehicle="drone7")
    eventually(lambda: late.mirror.current and late.mirror.version == voxels.version)
    assert known(late.mirror.voxels) == known(voxels)
    newest = [o.message for o in said if o.topic is topics.OCCUPIED][-1]
    (cloud,) = eventually(lambda: late.clouds)
    assert np.array_equal(cloud.points_odom, newest.points_odom) and np.array_equal(cloud.log_odds, newest.log_odds)
    fly(5)
    eventually(lambda: late.mirror.current and late.mirror.version == voxels.version)
    assert known(late.mirror.voxels) == known(voxels) and late.mirror.gaps == 0
