"""A bus of its own for each test: two sessions on a free port of the loopback."""

import socket
import time

import pytest

from companion.runtime.bus.graph import Graph
from companion.runtime.bus.session import open_session


@pytest.fixture
def endpoint():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def pair(endpoint):
    """(graph on the router, graph on a peer)."""
    with (
        open_session("router", endpoint=endpoint) as router,
        open_session("peer", endpoint=endpoint) as peer,
        Graph(router) as first,
        Graph(peer) as second,
    ):
        yield first, second


@pytest.fixture
def eventually():
    def wait(condition, timeout_s=10.0):
        until_s = time.monotonic() + timeout_s
        while not (found := condition()):
            assert time.monotonic() < until_s, "never came true"
            time.sleep(0.01)
        return found

    return wait
