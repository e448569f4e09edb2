"""Point clouds are read by Open3D as they were written."""

import numpy as np
import pytest

from companion.mapping.formats.points import write_pcd, write_ply
from companion.mapping.formats.stored_map import StoredMap
from companion.mapping.sensor_model import quantise
from tests.unit.mapping.random_maps import OURS, random_map


def open3d():
    import ctypes

    import libusb_package

    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    return pytest.importorskip("open3d")


@pytest.mark.parametrize("suffix, write, extra", [(".ply", write_ply, "occupancy"), (".pcd", write_pcd, "intensity")])
def test_open3d_reads_our_centres_and_probabilities(suffix, write, extra, tmp_path):
    stored = random_map(5).canonical()
    path = tmp_path / f"map{suffix}"
    path.write_bytes(write(stored))
    cloud = open3d().t.io.read_point_cloud(str(path))
    centers, p = stored.occupied()
    assert np.allclose(cloud.point["positions"].numpy(), centers, atol=1e-5)
    assert np.allclose(cloud.point[extra].numpy()[:, 0], p, atol=1e-6)


def test_centres_and_probabilities_are_those_of_the_cells():
    log_odds = np.full((1, 512), -128, np.int8)
    log_odds[0, 0], log_odds[0, 511], log_odds[0, 8] = quantise(OURS).highest, 0, -1
    centers, p = StoredMap(0.5, OURS, np.array([[-1, 0, 2]], np.int32), log_odds).occupied()
    assert np.allclose(centers, [[-3.75, 0.25, 8.25], [-0.25, 3.75, 11.75]])
    assert np.allclose(p, [0.97, 0.5], atol=5e-3)
