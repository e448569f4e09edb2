"""A small analytic world (ground, trunks) and a short flight through it, for tests only."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.ndimage import gaussian_filter, gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from companion.core.geometry import quaternion_from_rotation
from companion.core.messages import CameraImage, ImuSample, LidarScan
from companion.core.rig import Rig

G = 9.80665
REST_S = 1.6
GYRO_BIAS = np.array([0.004, -0.006, 0.003])
ACCEL_BIAS = np.array([0.06, -0.05, 0.04])


@dataclass
class Flight:
    """Truth in a world whose origin and heading are those of the start."""

    t: np.ndarray  # s, (N,), 1 kHz
    p: np.ndarray
    v: np.ndarray
    R: Rotation

    def pose(self, t):
        t = np.clip(t, self.t[0], self.t[-1])
        p = np.column_stack([np.interp(t, self.t, self.p[:, k]) for k in range(3)])
        return self._slerp(t), p

    def velocity(self, t):
        return np.array([np.interp(t, self.t, self.v[:, k]) for k in range(3)])

    def __post_init__(self):
        self._slerp = Slerp(self.t, self.R)


def flight(seconds=12.0, speed=3.0):
    """Stand, climb while setting off, weave through the trunks."""
    t = np.arange(0, seconds + 0.2, 0.001)
    h = np.clip((t - REST_S) / 2.5, 0, 1)
    h = h**3 * (h * (6 * h - 15) + 10)
    s = np.cumsum(h) * 0.001 * speed
    p = np.column_stack([s, 1.5 * np.sin(s / 4) * h, 0.1 + 2.2 * h + 0.2 * np.sin(0.8 * s) * h])
    p = gaussian_filter1d(p, 60, axis=0, mode="nearest")
    p[:, :2] -= p[0, :2]
    v = np.gradient(p, 0.001, axis=0)
    a = np.gradient(v, 0.001, axis=0)
    up = a + np.array([0, 0, G])
    yaw = 0.4 * np.sin(0.7 * (t - REST_S)) * h
    heading = np.column_stack([np.cos(yaw), np.sin(yaw), 0 * yaw])
    z = up / np.linalg.norm(up, axis=1, keepdims=True)
    y = np.cross(z, heading)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    R = Rotation.from_matrix(np.stack([np.cross(y, z), y, z], axis=-1))
    return Flight(t, p, v, R)


def imu_samples(f, rng, *, gyro_noise=2e-4, accel_noise=2e-3, vibration=(0.01, 0.2)):
    """200 Hz, mean over the interval that ends at the stamp, biased; vibration in the air only."""
    step = 5
    dt = 0.005
    R = f.R[::step]
    v = f.v[::step]
    rate = (R[:-1].inv() * R[1:]).as_rotvec() / dt
    middle = f.R[2::step][: len(rate)]
    force = middle.inv().apply(np.diff(v, axis=0) / dt + [0, 0, G])
    air = (f.t[step::step] > REST_S)[: len(rate), None]
    n = (len(rate), 3)
    rate = rate + GYRO_BIAS + rng.normal(0, gyro_noise / dt**0.5, n) + air * rng.normal(0, vibration[0], n)
    force = force + ACCEL_BIAS + rng.normal(0, accel_noise / dt**0.5, n) + air * rng.normal(0, vibration[1], n)
    stamps = np.round(f.t[step::step] * 1e9).astype(np.int64)
    return [
        ImuSample(stamp_ns=int(s), angular_velocity_body=w, specific_force_body=a)
        for s, w, a in zip(stamps, rate, force, strict=False)
    ]


def trunks(seed=1, n=160, path=None):
    """x, y, radius of vertical cylinders beside the path, (N, 3)."""
    rng = np.random.default_rng(seed)
    c = np.column_stack([rng.uniform(-20, 55, n), rng.uniform(-25, 25, n), rng.uniform(0.1, 0.3, n)])
    away = np.linalg.norm(c[:, None, :2] - path[None, ::200, :2], axis=2).min(axis=1) > 1.2
    return c[away]


def lidar_scan(f, end_s, rig, world, rng, *, beams=16, azimuths=512, noise_m=0.02, max_range=60.0):
    """One sweep of 0.1 s: every ray starts from the pose of its own time."""
    azimuth = np.repeat(np.arange(azimuths) / azimuths, beams)
    elevation = np.tile(np.radians(np.linspace(-25, 20, beams)), azimuths)
    age = 0.1 * (1 - azimuth)
    angle = 2 * np.pi * azimuth
    dirs = np.column_stack([np.cos(elevation) * np.cos(angle), np.cos(elevation) * np.sin(angle), np.sin(elevation)])
    R, p = f.pose(end_s - age)
    origin = p + R.apply(rig.lidar.p_body)
    rays = (R * Rotation.from_matrix(rig.lidar.R_body_sensor)).apply(dirs)
    hit = cast(origin, rays, world)
    ranges = hit + rng.normal(0, noise_m, len(hit))
    seen = (hit < max_range) & (hit > 0.4)
    return LidarScan(
        stamp_ns=round(end_s * 1e9),
        points_sensor=(dirs[seen] * ranges[seen, None]).astype(np.float32),
        point_age_s=age[seen].astype(np.float32),
        miss_dirs_sensor=dirs[~seen].astype(np.float32),
        miss_age_s=age[~seen].astype(np.float32),
    )


@njit(cache=True)
def cast(origins, rays, world):
    """Distance to the ground z = 0 or to the nearest trunk (12 m high), inf if none."""
    out = np.full(len(rays), np.inf)
    for q in range(len(rays)):
        ox, oy, oz = origins[q]
        dx, dy, dz = rays[q]
        best = -oz / dz if dz < -1e-6 else np.inf
        flat2 = dx * dx + dy * dy
        for k in range(len(world)):
            cx, cy, r = world[k, 0] - ox, world[k, 1] - oy, world[k, 2]
            b = cx * dx + cy * dy
            if b <= 0:
                continue
            disc = b * b - flat2 * (cx * cx + cy * cy - r * r)
            if disc < 0:
                continue
            t = (b - np.sqrt(disc)) / flat2
            if 0 < t < best and 0 < oz + t * dz < 12:
                best = t
        out[q] = best
    return out


class Ground:
    """A textured plane z = 0, 2 cm per pixel, seen by the downward camera."""

    def __init__(self, seed=3):
        rng = np.random.default_rng(seed)
        noise = rng.normal(size=(1024, 1024))
        layers = [gaussian_filter(noise, s, mode="wrap") * s for s in (1.0, 3.0, 8.0)]
        self.texture = sum(layers)
        self.texture = 128 + 45 * self.texture / self.texture.std()

    def image(self, f, t, rig, rng):
        pinhole = rig.pinhole
        cx, cy = pinhole.center_px
        u, v = np.meshgrid(np.arange(pinhole.width_px) + 0.5 - cx, np.arange(pinhole.height_px) + 0.5 - cy)
        optical = np.column_stack([u.ravel(), v.ravel(), np.full(u.size, pinhole.focal_px)])
        R, p = f.pose(np.array([t]))
        R = R.as_matrix()[0]
        rays = optical @ (R @ rig.camera.R_body_sensor).T
        origin = p[0] + R @ rig.camera.p_body
        at = origin + rays * (-origin[2] / np.minimum(rays[:, 2], -1e-3))[:, None]
        x, y = at[:, 0] / 0.02, at[:, 1] / 0.02
        i, j = np.floor(x).astype(int), np.floor(y).astype(int)
        a, b = x - i, y - j
        T = self.texture
        n = len(T)
        i, j, i1, j1 = i % n, j % n, (i + 1) % n, (j + 1) % n
        grey = (T[j, i] * (1 - a) + T[j, i1] * a) * (1 - b) + (T[j1, i] * (1 - a) + T[j1, i1] * a) * b
        grey = np.clip(grey + rng.normal(0, 2, len(grey)), 0, 255).astype(np.uint8)
        return CameraImage(stamp_ns=round(t * 1e9), pixels=grey.reshape(v.shape))


def record(seconds=12.0, *, seed=0, camera=False, rig=None, max_range=60.0, lidar_delay_s=0.02, forest=True):
    """(arrival s, message) of a whole flight in order of arrival, and the truth."""
    rig = rig or Rig()
    rng = np.random.default_rng(seed)
    f = flight(seconds)
    world = trunks(path=f.p) if forest else np.array([[500.0, 500.0, 0.1]])
    events = [(m.stamp_ns * 1e-9, m) for m in imu_samples(f, rng)]
    for k in range(2, int(seconds * 10)):
        scan = lidar_scan(f, k / 10, rig, world, rng, max_range=max_range)
        events.append((k / 10 + lidar_delay_s, scan))
    if camera:
        ground = Ground()
        for k in range(2, int(seconds * 15)):
            events.append((k / 15 + 0.015, ground.image(f, k / 15, rig, rng)))
    return f, sorted(events, key=lambda e: e[0])


def quaternions(R):
    return np.array([quaternion_from_rotation(m) for m in R.as_matrix()])
