"""Voxels as pictures: the right pixels, the nearest in front."""

import numpy as np
import pytest
from PIL import Image

from companion.core.errors import InputError
from companion.mapping.formats.stored_map import StoredMap
from companion.report.map_picture import draw_map
from companion.report.voxel_render import ABOVE, NORTHWARD, OBLIQUE, render
from tests.unit.mapping.random_maps import OURS, random_map

RED, GREEN = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]


@pytest.mark.parametrize("view", [ABOVE, NORTHWARD, OBLIQUE])
def test_the_axes_of_a_view_are_orthonormal(view):
    assert np.allclose(view.axes @ view.axes.T, np.eye(3), atol=1e-12)


def test_from_above_east_is_right_north_is_up_and_the_highest_is_seen():
    centers = np.array([[0.5, 0.5, 0.5], [0.5, 0.5, 5.5], [4.5, 2.5, 0.5]])
    picture = render(centers, np.array([RED, GREEN, RED]), 1.0, ABOVE, 100)
    assert np.allclose(picture.extent, [0.0, 5.0, 0.0, 3.0], atol=0.06)
    height, width = picture.rgba.shape[:2]
    assert (picture.rgba[height - 10, 10, :3] == [0, 255, 0]).all()  # lower left: the green one hides the red
    assert picture.rgba[10, width - 10, 0] > 127
    assert picture.rgba[10, 10, 3] == 0
    assert np.count_nonzero(picture.rgba[..., 3]) == pytest.approx(2 * 20 * 20, rel=0.15)  # two squares of 20 pixels


def test_looking_north_the_southern_is_in_front():
    centers = np.array([[0.5, 9.5, 0.5], [0.5, 0.5, 0.5]])
    picture = render(centers, np.array([RED, GREEN]), 1.0, NORTHWARD, 100)
    middle = picture.rgba[picture.rgba.shape[0] // 2, picture.rgba.shape[1] // 2]
    assert middle.tolist() == [0, 255, 0, 255]


def test_a_floor_has_no_gaps_at_an_angle():
    ij = np.indices((30, 30)).reshape(2, -1).T
    centers = np.column_stack([ij, np.zeros(len(ij))]) * 0.1
    on_it = np.column_stack([np.random.default_rng(0).uniform(0.1, 2.8, (5000, 2)), np.full(5000, 0.05)])
    right, up = OBLIQUE.axes[:2] @ on_it.T
    for width in (40, 97, 300, 1000):
        picture = render(centers, np.ones((len(ij), 3)), 0.1, OBLIQUE, width)
        left, right_end, bottom, top = picture.extent
        height, wide = picture.rgba.shape[:2]
        x = ((right - left) / (right_end - left) * wide).astype(int)
        y = ((top - up) / (top - bottom) * height).astype(int)
        assert np.all(picture.rgba[y, x, 3] == 255)


def test_the_picture_of_a_map_is_written(tmp_path):
    draw_map(random_map(2).canonical(), tmp_path / "map.png", "a map")
    with Image.open(tmp_path / "map.png") as picture:
        pixels = np.asarray(picture.convert("RGB"))
    assert pixels.shape[1] == 1350
    assert np.mean(np.any(pixels != 255, axis=2)) > 0.05


def test_the_same_voxels_give_the_same_picture():
    stored = random_map(2).canonical()
    centers, p = stored.occupied()
    colors = np.repeat(p[:, None].astype(float), 3, axis=1)
    one, two = (render(centers, colors, 0.2, OBLIQUE, 300).rgba for _ in range(2))
    assert np.array_equal(one, two)


def test_a_map_without_an_occupied_voxel_cannot_be_drawn(tmp_path):
    free = StoredMap(0.2, OURS, np.zeros((1, 3), np.int32), np.full((1, 512), -3, np.int8))
    with pytest.raises(InputError, match="nothing to draw"):
        draw_map(free, tmp_path / "map.png", "")
