"""The landmark node over a painted plane: landmarks lie where they are seen, and are found again."""

import dataclasses
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from local_maps import cylinder, plane_map, with_cells

from companion.core.geometry import exp_so3, quaternion_from_rotation
from companion.core.messages import CameraImage, Odometry, freeze
from companion.core.rig import Rig
from companion.core.topics import CAMERA, LANDMARKS, LOCAL_MAP, ODOMETRY
from companion.mapping.association import TRUNK, VISUAL
from companion.mapping.feature_map import FeatureMap
from companion.mapping.keypoints import Keypoints
from companion.mapping.landmark_node import LandmarkConfig, LandmarkNode

RIG = Rig()
PX_PER_M, FRAME_NS, POSE_NS = 100.0, 66_666_667, 10_000_000
SIDE_M = 12.0


def painting():
    noise = np.random.default_rng(0).normal(size=(int(SIDE_M * PX_PER_M),) * 2)
    smooth = sum(cv2.GaussianBlur(noise, (0, 0), s) * s for s in (1.5, 3.0, 6.0))
    return np.clip(128 + 50 * smooth / smooth.std(), 0, 255).astype(np.uint8)


PAINTING = painting()


def frame(stamp_ns, p, R):
    """What the camera of the rig sees of the painting on z = 0."""
    R_cam, origin = R @ RIG.camera.R_body_sensor, p + R @ RIG.camera.p_body
    f, (cx, cy) = RIG.pinhole.focal_px, RIG.pinhole.center_px
    K = np.array([[f, 0, cx - 0.5], [0, f, cy - 0.5], [0, 0, 1]])  # OpenCV's pixel centres
    to_world = np.array([[1 / PX_PER_M, 0, -SIDE_M / 2], [0, 1 / PX_PER_M, -SIDE_M / 2], [0, 0, 1]])
    onto_plane = K @ R_cam.T @ np.column_stack([np.eye(3)[:, :2], -origin])  # (x, y, 1) -> image
    pixels = cv2.warpPerspective(PAINTING, onto_plane @ to_world, (320, 240), flags=cv2.INTER_AREA)
    return freeze(CameraImage(stamp_ns=stamp_ns, pixels=pixels))


def odometry(stamp_ns, p, R, reset=0):
    variance = np.array([1e-5, 1e-5, 1e-5, 1e-4, 1e-4, 1e-4])
    return freeze(
        Odometry(
            stamp_ns=stamp_ns,
            p_odom=p,
            q_odom_body=quaternion_from_rotation(R),
            v_odom=np.zeros(3),
            omega_body=np.zeros(3),
            pose_variance=variance,
            velocity_variance=np.zeros(3),
            measured_ns=stamp_ns,
            quality=1.0,
            reset_counter=reset,
        )
    )


def way(t_s):
    """Back and forth over 2 m within 8 s, with a little roll."""
    swing = np.sin(2 * np.pi * t_s / 8.0)
    return np.array([swing, 0.3 * swing, 2.0]), exp_so3(np.array([0.1 * swing, 0.05, 0.0]))


def fly(node, seconds, local_map=None, poses=True):
    local_map = plane_map() if local_map is None else local_map
    sent = []
    frames = 0
    for now_ns in range(0, int(seconds * 1e9), POSE_NS):
        if poses:
            sent += node.handle(ODOMETRY, odometry(now_ns, *way(now_ns * 1e-9)))
        if now_ns % 200_000_000 == 0:
            sent += node.handle(LOCAL_MAP, dataclasses.replace(local_map, stamp_ns=now_ns))
        while now_ns >= frames * FRAME_NS + 30_000_000:  # an image is late
            sent += node.handle(CAMERA, frame(frames * FRAME_NS, *way(frames * FRAME_NS * 1e-9)))
            frames += 1
    return [o.message for o in sent if o.topic is LANDMARKS]


@pytest.fixture(scope="module")
def flown():
    node = LandmarkNode(LandmarkConfig(), RIG)
    return node, fly(node, 16.0)


def test_images_are_looked_at_as_often_as_configured(flown):
    node, messages = flown
    assert node.images + node.skipped == pytest.approx(16 * 1.5, abs=2)
    assert node.skipped <= 1
    assert len(messages) == node.images // 8


def test_landmarks_lie_on_the_plane_and_are_found_again(flown):
    node, _ = flown
    seen = node.features.landmarks
    assert (seen["kind"] == VISUAL).all()
    assert (seen["observations"] >= 4).sum() > 60
    assert seen["observations"].sum() > 2.5 * len(seen)  # a look at 6 s and one at 14 s are of one place
    assert np.abs(seen["position_odom"][:, 2]).max() < 0.05  # fused along slanted rays, the mean leaves the plane


def test_positions_agree_with_where_the_painting_shows_the_landmark(flown):
    """From a pose of its own: where the landmark projects to, some image point has its descriptor."""
    node, _ = flown
    p, R = way(5.0)
    uv, bits = Keypoints(node.config.keypoints).find(frame(0, p, R).pixels)
    known = node.features.landmarks[node.features.landmarks["observations"] >= 3]
    optical = ((known["position_odom"] - p) @ R - RIG.camera.p_body) @ RIG.camera.R_body_sensor
    at = optical[:, :2] / optical[:, 2:] * RIG.pinhole.focal_px + RIG.pinhole.center_px
    there = np.linalg.norm(at[:, None] - uv, axis=2) < 2.0
    flips = np.bitwise_count(known["descriptor"][:, None] ^ bits).sum(axis=2)
    fewest = np.where(there, flips, 256).min(axis=1)[there.any(axis=1)]
    assert len(fewest) > 15
    assert np.median(fewest) < 50  # of strangers: 128
    assert np.median(flips[~there]) > 100


def test_the_message_is_the_map(flown):
    node, messages = flown
    again = LandmarkNode(LandmarkConfig(), RIG)
    for message in fly(again, 16.0):
        last = message
    assert again.features.to_bytes() == node.features.to_bytes()
    np.testing.assert_array_equal(last.position_odom, messages[-1].position_odom)
    assert (np.diff(last.id) > 0).all()
    assert len(last.id) == len(last.position_odom) == len(last.sigma_m) == len(last.kind) == len(last.observations)
    assert (last.sigma_m > 0).all()


def test_the_map_survives_as_bytes(flown):
    node, _ = flown
    back = FeatureMap.from_bytes(node.features.to_bytes(), node.config.features)
    assert back.landmarks.tobytes() == node.features.landmarks.tobytes()


def test_trunks_of_the_local_map_become_landmarks():
    local_map = with_cells(plane_map(), cylinder(3.0, 2.0, 0.15, -1.0, 5.0), hides_ground=True)
    node = LandmarkNode(LandmarkConfig(), RIG)
    fly(node, 6.0, local_map)
    trees = node.features.landmarks[node.features.landmarks["kind"] == TRUNK]
    assert trees["observations"].tolist() == [3]  # at 0, 2.6 and 5.2 s: the map is a 5 Hz one, looked at every 2.5 s
    np.testing.assert_allclose(trees["position_odom"], [[3.0, 2.0, 1.4]], atol=0.12)


def test_without_poses_or_map_or_when_disabled_nothing_is_seen():
    blind = LandmarkNode(LandmarkConfig(), RIG)
    fly(blind, 2.0, poses=False)
    assert (len(blind.features), blind.images, blind.skipped) == (0, 0, 3)
    off = LandmarkNode(LandmarkConfig(enabled=False), RIG)
    assert fly(off, 2.0) == []
    assert (len(off.features), off.images, off.skipped) == (0, 0, 0)


def test_a_new_start_of_the_estimate_forgets_the_poses():
    node = LandmarkNode(LandmarkConfig(), RIG)
    list(node.handle(LOCAL_MAP, plane_map()))
    p, R = way(0.0)
    for k in range(10):
        list(node.handle(ODOMETRY, odometry(k * POSE_NS, p, R)))
    list(node.handle(CAMERA, frame(5 * POSE_NS, p, R)))
    list(node.handle(ODOMETRY, odometry(10 * POSE_NS, p, R, reset=1)))
    list(node.handle(CAMERA, frame(11 * POSE_NS, p, R)))
    assert (node.images, node.skipped) == (0, 1)
