"""Both renderers give the same bytes in any order; the worker's failures come home."""

import os
import signal

import numpy as np
import pytest

from companion.core.rig import Rig
from sim.sensors.camera import CameraConfig
from sim.sensors.lidar import LidarConfig
from sim.sensors.render import InlineRenderer, RenderError, WorkerRenderer
from sim.world import load_world

Q = np.array([[1.0, 0.0, 0.0, 0.0], [0.999, 0.02, 0.03, 0.01]])
P = np.array([[0.0, 0.0, 2.5], [0.4, 0.1, 2.6]])


@pytest.fixture(scope="module")
def parts():
    world = load_world("poisson", seed=1, options={"size_m": 40.0, "branches": 10})
    return world, LidarConfig(points=4000), CameraConfig(), Rig()


def requests(renderer, count):
    return [
        job
        for k in range(count)
        for job in (
            renderer.submit_lidar(P + k * 0.1, Q, stamp_ns=k, counter=k),
            renderer.submit_camera(P[0] + k * 0.1, Q[1], stamp_ns=k, counter=k),
        )
    ]


def as_bytes(message):
    return b"".join(
        v.tobytes() if isinstance(v, np.ndarray) else repr(v).encode()
        for v in (getattr(message, name) for name in message.__slots__)
    )


@pytest.fixture(scope="module")
def worker(parts):
    with WorkerRenderer(*parts, seed=3) as renderer:
        yield renderer


def test_inline_and_worker_give_equal_bytes_in_any_order(parts, worker):
    with InlineRenderer(*parts, seed=3) as inline:
        expected = [as_bytes(job.result()) for job in requests(inline, 8)]
        jobs = requests(worker, 8)  # more than the worker has slots
        assert [as_bytes(job.result()) for job in reversed(jobs)] == expected[::-1]
        assert [as_bytes(job.result()) for job in jobs] == expected  # a result may be asked for twice
        later = inline.submit_lidar(P, Q, stamp_ns=0, counter=0).result()
        assert as_bytes(later) == expected[0]  # no state between requests
        assert worker.cpu_s["lidar"] > 0.0
        assert worker.cpu_s["camera"] > 0.0
        assert not later.points_sensor.flags.writeable
        assert not jobs[0].result().points_sensor.flags.writeable
    assert len(set(expected)) == 16


def test_another_seed_gives_other_noise_on_the_same_world(parts):
    with InlineRenderer(*parts, seed=3) as one, InlineRenderer(*parts, seed=4) as two:
        a = one.submit_camera(P[0], Q[0], stamp_ns=0, counter=0).result().pixels.astype(float)
        b = two.submit_camera(P[0], Q[0], stamp_ns=0, counter=0).result().pixels.astype(float)
    assert 0.5 < np.abs(a - b).mean() < 5.0


def test_an_error_in_the_worker_is_raised_here_and_the_worker_lives_on(worker):
    bad = worker.submit_lidar(P, Q, stamp_ns=0, counter=0, fog=0.5)
    good = worker.submit_camera(P[0], Q[0], stamp_ns=7, counter=0)
    with pytest.raises(RenderError, match="fog"):
        bad.result()
    assert good.result().stamp_ns == 7


def test_a_dead_worker_is_an_error_not_a_hang(parts):
    worker = WorkerRenderer(*parts, seed=3)
    worker.wait_ready()
    os.kill(worker._worker._process.pid, signal.SIGKILL)
    with pytest.raises(RenderError, match="died, exit code -9"):
        worker.submit_lidar(P, Q, stamp_ns=0, counter=0).result()
    worker.close()
    with pytest.raises(RenderError, match="closed"):
        worker.submit_lidar(P, Q, stamp_ns=0, counter=0)


def test_closing_fails_what_nobody_fetched_and_ends_the_process(parts):
    worker = WorkerRenderer(*parts, seed=3)
    job = worker.submit_camera(P[0], Q[0], stamp_ns=0, counter=0)
    worker.close()
    worker.close()
    with pytest.raises(RenderError, match="closed"):
        job.result()
    assert not worker._worker._process.is_alive()
