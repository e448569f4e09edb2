"""2D grids: against columns walked one by one, and read back as map_server reads them."""

import re
from io import BytesIO

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from companion.core.errors import InputError
from companion.mapping.formats.grid import Grid2D, ground_height, occupancy_grid
from companion.mapping.formats.map_server import MODES, image_of, suffix_of, yaml_of
from companion.mapping.formats.stored_map import StoredMap
from companion.mapping.sensor_model import UNKNOWN, quantise
from tests.unit.mapping.random_maps import OURS, random_map

CELL_M = 0.2
SEEDS = st.integers(0, 10_000)


def map_of(dense, first_block=(0, 0, 0)):
    """A map of steps (8a, 8b, 8c)."""
    corners = np.indices([n // 8 for n in dense.shape]).reshape(3, -1).T
    cells = [dense[8 * i : 8 * i + 8, 8 * j : 8 * j + 8, 8 * k : 8 * k + 8].reshape(-1) for i, j, k in corners]
    return StoredMap(CELL_M, OURS, (corners + first_block).astype(np.int32), np.array(cells, np.int8)).canonical()


def cells_of(stored):
    """(x, y, z) -> step, of all known cells."""
    row, cell = np.nonzero(stored.log_odds != UNKNOWN)
    inside = np.stack([cell >> 6, (cell >> 3) & 7, cell & 7], axis=1)
    places = 8 * stored.block_xyz[row] + inside
    return dict(zip(map(tuple, places.tolist()), stored.log_odds[row, cell].tolist(), strict=True))


def read_as_map_server(image, text):
    """Occupancy as nav2_map_server gives it (-1, or 0 .. 100), P by its formula (X, Y), and the facts."""
    facts = yaml.safe_load(text)
    picture = Image.open(BytesIO(image))
    pixels = np.asarray(picture)[::-1]
    shade = (pixels[..., 0] if pixels.ndim == 3 else pixels).astype(float) / 255.0
    opaque = pixels[..., 1] == 255 if pixels.ndim == 3 else np.ones(shade.shape, bool)
    occ = shade if facts["negate"] else 1.0 - shade
    if facts["mode"] == "trinary":
        value = np.where(occ > facts["occupied_thresh"], 100, np.where(occ < facts["free_thresh"], 0, -1))
    elif facts["mode"] == "scale":
        ratio = (occ - facts["free_thresh"]) / (facts["occupied_thresh"] - facts["free_thresh"])
        value = np.where(opaque, np.clip(np.rint(100 * ratio), 0, 100), -1)
    else:
        percent = np.round(shade * 255)
        value = np.where(percent <= 100, percent, -1)
        occ = percent / 100
    return value.T, np.where(value == -1, np.nan, occ).T, facts


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS, low=st.integers(-25, 25), layers=st.integers(1, 30))
def test_a_band_is_the_highest_of_each_column(seed, low, layers):
    stored = random_map(seed).canonical()
    best = {}
    for (x, y, z), step in cells_of(stored).items():
        if low <= z < low + layers:
            best[x, y] = max(best.get((x, y), UNKNOWN), step)
    if not best:
        with pytest.raises(InputError, match="nothing is known"):
            occupancy_grid(stored, low * CELL_M, (low + layers) * CELL_M)
        return
    grid = occupancy_grid(stored, low * CELL_M, (low + layers) * CELL_M)
    corner = np.rint(grid.origin_xy / CELL_M).astype(int)
    assert corner.tolist() == [min(p[axis] for p in best) for axis in (0, 1)]
    per_unit = quantise(OURS).per_unit
    expected = np.full(grid.probability.shape, np.nan)
    for (x, y), step in best.items():
        expected[x - corner[0], y - corner[1]] = 1 / (1 + np.exp(-step / per_unit))
    assert np.allclose(grid.probability, expected, atol=1e-6, equal_nan=True)


def test_a_slice_takes_the_layers_that_the_band_reaches_into():
    dense = np.full((8, 8, 16), -1, np.int8)
    dense[0, 0, 6] = dense[1, 0, 7] = dense[2, 0, 5] = 20
    stored = map_of(dense)
    for low, high, hit in (
        (1.3, 1.3, [0]),
        (1.2, 1.4, [0]),
        (1.2, 1.41, [0, 1]),
        (1.19, 1.4, [0, 2]),
        (1.0, 1.6, [0, 1, 2]),
    ):
        occupied = np.argwhere(occupancy_grid(stored, low, high).probability > 0.5)
        assert occupied.tolist() == [[x, 0] for x in hit], (low, high)


def test_a_band_above_ground_follows_the_slope():
    dense = np.full((32, 16, 32), UNKNOWN, np.int8)
    x = np.arange(32)
    level = 2 + x // 4
    for i in x:
        dense[i, :, level[i]] = 20
        dense[i, :, level[i] + 1 :] = -3
    dense[13, 5, level[13] : 31] = 20  # a trunk
    stored = map_of(dense, (-2, 3, -1))
    ground = ground_height(stored)
    assert np.allclose(ground, ((level - 8 + 0.5) * CELL_M)[:, None], atol=1e-6)
    grid = occupancy_grid(stored, 0.5, 1.0, ground_z=ground)
    assert np.argwhere(grid.probability > 0.5).tolist() == [[13, 5]]
    assert np.allclose(grid.origin_xy, [-16 * CELL_M, 24 * CELL_M])
    assert np.all(np.isfinite(grid.probability))
    flat = occupancy_grid(stored, 0.0, 0.3)
    assert np.count_nonzero(flat.probability > 0.5) > 30


def test_columns_without_ground_take_the_nearest_and_none_at_all_is_told():
    dense = np.full((16, 8, 8), -3, np.int8)
    dense[:, :, 0] = 20
    dense[4, 4, 0] = UNKNOWN
    assert np.allclose(ground_height(map_of(dense)), 0.1)
    with pytest.raises(InputError, match="no ground"):
        ground_height(map_of(np.full((8, 8, 8), -3, np.int8)))


def test_ground_is_seen_across_blocks():
    dense = np.full((8, 8, 16), UNKNOWN, np.int8)
    dense[:, :, 7] = 20
    dense[:, :, 8] = -3
    assert np.allclose(ground_height(map_of(dense)), 7.5 * CELL_M)


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS, mode=st.sampled_from(MODES))
def test_map_server_reads_the_probability_and_the_class_of_each_cell(seed, mode):
    grid = occupancy_grid(random_map(seed).canonical(), -5.0, 5.0)
    image, text = image_of(grid, mode), yaml_of(grid, "forest" + suffix_of(mode), mode)
    value, p, facts = read_as_map_server(image, text)
    known = np.isfinite(grid.probability)
    assert np.array_equal(value == -1, ~known)
    assert np.abs(p - grid.probability)[known].max() <= (1 / 200 if mode == "raw" else 1 / 255) + 1e-6
    if mode == "trinary":
        assert np.array_equal(value[known] == 100, grid.probability[known] >= 0.5)
    else:
        assert np.abs(value[known] / 100 - grid.probability[known]).max() <= 0.5 / 100 + 1 / 255
    assert facts["image"] == "forest" + (".png" if mode == "scale" else ".pgm")
    assert facts["resolution"] == grid.resolution_m
    assert np.allclose(facts["origin"], [*grid.origin_xy, 0.0])


def test_every_step_keeps_its_class_and_its_probability():
    steps = np.arange(-127, 128, dtype=np.int8)
    dense = np.full((256, 8, 8), UNKNOWN, np.int8)
    dense[: len(steps), 0, 0] = steps
    grid = occupancy_grid(map_of(dense), 0.0, 0.2, crop=False)
    value, p, _ = read_as_map_server(image_of(grid), yaml_of(grid, "x.pgm"))
    assert np.array_equal(value[: len(steps), 0], np.where(steps >= 0, 100, 0))
    assert np.all(value[:, 1:] == -1)
    assert np.nanmax(np.abs(p - grid.probability)) <= 1 / 255


def test_rows_run_from_north_to_south():
    p = np.full((3, 2), 0.3, np.float32)
    p[2, 1] = 0.97  # east, north
    image = image_of(Grid2D(1.0, np.zeros(2), p))
    assert re.match(rb"P5\n3 2\n255\n", image)
    pixels = np.frombuffer(image[-6:], np.uint8).reshape(2, 3)
    assert np.unravel_index(pixels.argmin(), pixels.shape) == (0, 2)


@pytest.mark.parametrize("low, high", [(1.0, 0.0), (np.nan, 1.0), (0.0, np.nan), (-np.inf, np.inf), (0.0, 1e9)])
def test_a_band_that_is_none_is_told(low, high):
    with pytest.raises(InputError, match="no band"):
        occupancy_grid(random_map(0).canonical(), low, high)


def test_an_empty_map_a_wide_map_and_a_wrong_mode_are_told():
    cells = np.full((2, 512), -1, np.int8)
    with pytest.raises(InputError, match="empty"):
        occupancy_grid(StoredMap(0.2, OURS, np.empty((0, 3), np.int32), np.empty((0, 512), np.int8)), 0, 1)
    far = StoredMap(0.2, OURS, np.array([[0, 0, 0], [4000, 4000, 0]], np.int32), cells)
    with pytest.raises(InputError, match="too many"):
        occupancy_grid(far, 0, 1)
    with pytest.raises(InputError, match="trinary, scale, raw"):
        suffix_of("grey")
