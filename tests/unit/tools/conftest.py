"""A bus of its own for each test, with a node that talks; the tools run in this process."""

import contextlib
import json
import socket
import threading
import time

import pytest
from typer.testing import CliRunner

from companion.cli.main import app
from companion.runtime.bus.graph import Graph
from companion.runtime.bus.session import open_session
from companion.runtime.wire import wire_type
from companion.runtime.wire.keys import Qos
from companion.runtime.wire.type_hash import _individual


@pytest.fixture
def endpoint():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def graph(endpoint):
    with open_session("router", endpoint=endpoint) as session, Graph(session) as graph:
        yield graph


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

    def run(*arguments):
        return Result(CliRunner().invoke(app, [*arguments, "--bus", endpoint]))

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
