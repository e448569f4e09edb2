"""Keypoints: bounded per cell, at the same place of the picture wherever the picture is, the same every time."""

import cv2
import numpy as np

from companion.mapping.keypoints import KeypointConfig, Keypoints


def texture(shape=(400, 500), seed=0):
    noise = np.random.default_rng(seed).normal(size=shape)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5)
    return np.clip(128 + 60 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def test_each_cell_has_its_few_and_the_image_is_covered():
    config = KeypointConfig(candidates=2000, cell_px=40, per_cell=3)
    uv, bits = Keypoints(config).find(texture()[:240, :320])
    assert bits.shape == (len(uv), 32) and bits.dtype == np.uint8
    cells, counts = np.unique((uv - 0.5) // 40, axis=0, return_counts=True)
    assert counts.max() == 3
    assert len(cells) == 8 * 6
    assert (uv > 20).all() and (uv < [300, 220]).all()


def test_the_same_picture_elsewhere_gives_the_same_points():
    picture, shift = texture(), np.array([23, 41])  # px right, down
    config = KeypointConfig(candidates=5000, per_cell=1000, levels=1)
    finder = Keypoints(config)
    uv_a, bits_a = finder.find(picture[:240, :320])
    uv_b, bits_b = finder.find(picture[shift[1] : shift[1] + 240, shift[0] : shift[0] + 320])
    there = {tuple(uv): bits for uv, bits in zip(uv_b + shift, bits_b, strict=True)}
    inside = (uv_a > shift + 25).all(axis=1) & (uv_a < [295, 215]).all(axis=1)
    found = [there.get(tuple(uv)) for uv in uv_a[inside]]
    kept = [k for k, bits in enumerate(found) if bits is not None]
    assert inside.sum() > 100 and len(kept) > 0.95 * inside.sum()
    flips = [np.bitwise_count(found[k] ^ bits_a[inside][k]).sum() for k in kept]
    assert np.percentile(flips, 95) == 0


def test_a_turned_picture_is_known_by_its_bits():
    """At 90 degrees most points find their own descriptor nearest among all."""
    picture = texture()[:240, :240]
    finder = Keypoints(KeypointConfig(candidates=300, per_cell=10))
    uv_a, bits_a = finder.find(picture)
    uv_b, bits_b = finder.find(np.ascontiguousarray(np.rot90(picture)))  # (u, v) -> (v, 240 - u)
    turned = np.column_stack([uv_a[:, 1], 240 - uv_a[:, 0]])
    flips = np.bitwise_count(bits_a[:, None] ^ bits_b).sum(axis=2)
    near = np.linalg.norm(turned - uv_b[flips.argmin(axis=1)], axis=1) < 2.0
    again = (np.linalg.norm(turned[:, None] - uv_b, axis=2) < 2.0).any(axis=1)
    assert again.mean() > 0.6
    assert near[again].mean() > 0.9


def test_the_same_every_time_and_nothing_on_nothing():
    image = texture()[:240, :320]
    first = Keypoints(KeypointConfig()).find(image)
    again = Keypoints(KeypointConfig()).find(image)
    assert [a.tobytes() for a in first] == [b.tobytes() for b in again]
    for blank in (np.full((240, 320), 90, np.uint8), np.zeros((10, 12), np.uint8)):
        uv, bits = Keypoints(KeypointConfig()).find(blank)
        assert uv.shape == (0, 2) and bits.shape == (0, 32)
