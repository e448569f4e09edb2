"""A bus of our own, on which each test declares its nodes; the tools run in this process."""

import contextlib
import json
import socket
import threading
import time

import pytest
from typer.testing import CliRunner

from companion.cli import main
from companion.runtime.bus.graph import Graph
from companion.runtime.bus.session import open_session
from companion.runtime.wire import wire_type
from companion.runtime.wire.keys import Qos
from companion.runtime.wire.type_hash import _individual


def free_endpoint():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture(scope="session")
def bus():
    """(endpoint, session of the router): opened once, since opening takes half a second."""
    endpoint = free_endpoint()
    with open_session("router", endpoint=endpoint) as session:
        yield endpoint, session


@pytest.fixture
def endpoint(bus):
    return bus[0]


@pytest.fixture
def graph(bus):
    """What a test declares; gone after it."""
    with Graph(bus[1]) as graph:
        yield graph


@pytest.fixture
def nowhere():
    """An endpoint where nobody listens."""
    return free_endpoint()


class Result:
    """What a command came to."""

    def __init__(self, result):
        self.code, self.out, self.error = result.exit_code, result.stdout, result.exception

    @property
    def lines(self):
        return self.out.splitlines()

    @property
    def rows(self):
        return [json.loads(line) for line in self.lines]


@pytest.fixture
def companion(endpoint):
    """Run a command line on the test's bus."""
    whole = main.app

    def run(*arguments, bus=endpoint):
        return Result(CliRunner().invoke(whole, [*arguments, "--bus", bus]))

    return run


@pytest.fixture
def talking(graph):
    """Publish values of a type at a rate on a thread: `with talking(name, type, value_of, hz):`."""

    @contextlib.contextmanager
    def talk(name, kind, value_of, hz=100.0, qos=Qos(depth=10), skip=()):  # noqa: B008 (frozen)
        if isinstance(kind, str):
            kind = wire_type(kind)
        publisher = graph.node("talker", namespace="/drone1").publisher(name, kind, qos)
        ended = threading.Event()

        def work():
            begin_s, k = time.monotonic(), 0
            while not ended.wait(max(0.0, begin_s + k / hz - time.monotonic())):
                k += 1
                if k in skip:
                    publisher.sequence += 1  # numbered, never sent
                else:
                    publisher.put(kind.encode(value_of(k)), time.time_ns())

        thread = threading.Thread(target=work)
        thread.start()
        try:
            yield publisher
        finally:
            ended.set()
            thread.join()

    return talk


@pytest.fixture
def described():
    """The description of a type, as a ROS 2 node tells it."""

    def describe(kind):
        library = kind._types.library
        names = library.references(kind.name)
        return {
            "type_description": _individual(library.struct(kind.name)),
            "referenced_type_descriptions": [_individual(library.struct(n)) for n in names],
        }

    return describe
