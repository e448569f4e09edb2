"""Links on loopback and a pty: bytes both ways, one peer, reconnecting, never waiting."""

from __future__ import annotations

import contextlib
import os
import pty
import socket
import threading
import time
import tty

import pytest

from companion.core.errors import LinkError
from companion.runtime.ports.mavlink_link import open_link
from companion.runtime.ports.port import Outbox, Traffic

BEAT = b"\xfd" + bytes(11)


class Ear:
    """Collects what a link receives and reports."""

    def __init__(self):
        self.pieces, self.stamps, self.reports = [], [], []
        self.shift_ns = 0
        self._links = contextlib.ExitStack()

    def open(self, url, **options):
        return self._links.enter_context(
            open_link(url, self.take, clock=self.clock, report=self.reports.append, **options)
        )

    def clock(self):
        return time.monotonic_ns() + self.shift_ns

    def take(self, data, stamp_ns):
        self.pieces.append(data)
        self.stamps.append(stamp_ns)

    @property
    def bytes(self):
        return b"".join(self.pieces)


@pytest.fixture
def ear():
    ear = Ear()
    with ear._links:
        yield ear


@pytest.fixture
def peer():
    """A UDP socket of somebody else."""
    with contextlib.ExitStack() as stack:

        def make():
            sock = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            sock.bind(("127.0.0.1", 0))
            sock.settimeout(2.0)
            return sock

        yield make


def free_port(kind=socket.SOCK_DGRAM):
    with socket.socket(socket.AF_INET, kind) as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


def until(condition, seconds=5.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.005)


# --- UDP --------------------------------------------------------------------------------


def test_udp_in_answers_the_first_who_speaks_mavlink(ear, peer):
    port, talker = free_port(), peer()
    link = ear.open(f"udp://127.0.0.1:{port}")
    link.send(b"nobody is there")
    assert (link.stats.connected, link.stats.dropped) == (False, 1)
    talker.sendto(b"hello", ("127.0.0.1", port))  # not MAVLink
    talker.sendto(BEAT, ("127.0.0.1", port))
    until(lambda: ear.pieces)
    link.send(b"answer")
    assert talker.recv(100) == b"answer" and ear.pieces == [BEAT]
    s = link.stats
    assert (s.connected, s.peer) == (True, f"127.0.0.1:{talker.getsockname()[1]}")
    assert (s.datagrams_in, s.bytes_in, s.datagrams_out, s.bytes_out, s.foreign) == (1, len(BEAT), 1, 6, 1)
    assert 0 <= time.monotonic_ns() - ear.stamps[0] < 5e9


def test_udp_in_reports_a_second_speaker_once_and_follows_it_when_the_first_is_silent(ear, peer):
    port, first, second = free_port(), peer(), peer()
    link = ear.open(f"udpin://127.0.0.1:{port}")
    first.sendto(BEAT, ("127.0.0.1", port))
    until(lambda: ear.pieces)
    for _ in range(3):
        second.sendto(BEAT + b"2", ("127.0.0.1", port))
    until(lambda: link.stats.foreign == 3)
    link.send(b"to the first")
    assert first.recv(100) == b"to the first" and ear.pieces == [BEAT]
    assert len([r for r in ear.reports if "speaks too and is not listened to" in r]) == 1
    ear.shift_ns = 6 * 10**9  # silence
    assert not link.stats.connected
    second.sendto(BEAT + b"2", ("127.0.0.1", port))
    until(lambda: len(ear.pieces) == 2)
    link.send(b"to the second")
    assert second.recv(100) == b"to the second" and "fell silent" in ear.reports[-1]


def test_udp_out_sends_first_and_hears_only_its_peer(ear, peer):
    target, stranger = peer(), peer()
    link = ear.open(f"udp://127.0.0.1:{target.getsockname()[1]}", udp_means="out")
    link.send(BEAT)
    data, address = target.recvfrom(100)
    assert data == BEAT and not link.stats.connected
    stranger.sendto(BEAT, address)
    target.sendto(b"any bytes", address)
    until(lambda: ear.pieces)
    assert ear.pieces == [b"any bytes"] and link.stats.connected and link.stats.foreign == 1


def test_udp_out_to_a_closed_port_neither_raises_nor_ends(ear, peer):
    port = free_port()
    link = ear.open(f"udpout://127.0.0.1:{port}")
    for _ in range(20):
        link.send(BEAT)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as late:
        late.bind(("127.0.0.1", port))
        late.settimeout(2.0)
        link.send(b"now")
        assert late.recv(100) == b"now"


def test_udp_too_long_for_a_datagram_is_counted_not_raised(ear, peer):
    target = peer()
    link = ear.open(f"udpout://127.0.0.1:{target.getsockname()[1]}")
    link.send(bytes(70_000))
    assert link.stats.dropped == 1


@pytest.mark.parametrize("scheme, kind", [("udpin", socket.SOCK_DGRAM), ("tcpin", socket.SOCK_STREAM)])
def test_an_address_in_use_is_a_clear_error(ear, scheme, kind):
    url = f"{scheme}://127.0.0.1:{free_port(kind)}"
    ear.open(url)
    with pytest.raises(LinkError, match=f"another companion or ground station listens on {url}") as caught:
        ear.open(url)
    assert caught.value.exit_code == 3


def test_an_address_of_another_machine_is_a_clear_error(ear):
    with pytest.raises(LinkError, match="this machine has no such address"):
        ear.open("udpin://192.0.2.1:14540")


def test_ipv6(ear):
    port = free_port()
    try:
        link = ear.open(f"udpin://[::1]:{port}")
    except LinkError:
        pytest.skip("no IPv6 here")
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as sock:
        sock.sendto(BEAT, ("::1", port))
        until(lambda: ear.pieces)
        assert link.stats.peer.startswith("[::1]:")


# --- TCP --------------------------------------------------------------------------------


def test_tcp_both_ways_reconnects_and_tells(ear):
    port = free_port(socket.SOCK_STREAM)
    client = ear.open(f"tcp://127.0.0.1:{port}")
    until(lambda: "Connection refused" in client.stats.trouble)
    client.send(b"lost")
    assert client.stats.dropped == 1 and any("Connection refused; trying again" in r for r in ear.reports)
    other = Ear()
    with other._links:
        server = other.open(f"tcpin://127.0.0.1:{port}")
        until(lambda: server.stats.connected and client.stats.connected)
        client.send(b"to the server")
        server.send(b"to the client")
        until(lambda: other.bytes == b"to the server" and ear.bytes == b"to the client")
        assert client.stats.trouble == ""
    until(lambda: not client.stats.connected)
    assert any("closed the connection" in r for r in ear.reports)
    with other._links:
        server = other.open(f"tcpin://127.0.0.1:{port}")
        until(lambda: client.stats.connected)
        assert client.stats.reconnects == 1


def test_tcp_in_serves_one_client_and_then_the_next(ear):
    port = free_port(socket.SOCK_STREAM)
    link = ear.open(f"tcpin://127.0.0.1:{port}")
    with socket.create_connection(("127.0.0.1", port), 2.0) as first:
        until(lambda: link.stats.connected)
        with socket.create_connection(("127.0.0.1", port), 2.0) as second:
            assert second.recv(10) == b""  # turned away
        assert link.stats.foreign == 1 and any("turned away" in r for r in ear.reports)
        first.sendall(b"one")
        until(lambda: ear.bytes == b"one")
    until(lambda: not link.stats.connected)
    with socket.create_connection(("127.0.0.1", port), 2.0) as third:
        third.sendall(b"three")
        until(lambda: ear.bytes == b"onethree")


def test_a_peer_that_does_not_read_never_makes_send_wait(ear):
    port = free_port(socket.SOCK_STREAM)
    link = ear.open(f"tcpin://127.0.0.1:{port}")
    frame = bytes([0xFD]) * 280
    with socket.create_connection(("127.0.0.1", port), 2.0) as lazy:
        until(lambda: link.stats.connected)
        while link.stats.dropped < 50:  # it reads nothing: a send that waits would wait for ever
            link.send(frame)
        lazy.settimeout(2.0)
        taken = 0
        while taken < link.stats.bytes_out:
            taken += len(lazy.recv(1 << 20))
        link.send(b"the newest")
        until(lambda: link.stats.datagrams_out > 0 and _tail(lazy) == b"the newest")


def _tail(sock):
    data = b""
    with contextlib.suppress(TimeoutError):
        sock.settimeout(0.2)
        while chunk := sock.recv(1 << 20):
            data += chunk
    return data[-10:]


# --- serial -----------------------------------------------------------------------------


@pytest.fixture
def line(tmp_path):
    """A pty whose device has a fixed name, so that it can be unplugged: (plug, unplug)."""
    device, ends = tmp_path / "ttyACM0", []

    def plug():
        master, slave = pty.openpty()
        tty.setraw(master)
        device.unlink(missing_ok=True)
        device.symlink_to(os.ttyname(slave))
        ends[:] = [master, slave]
        return master

    def unplug():
        device.unlink(missing_ok=True)
        for descriptor in ends:
            os.close(descriptor)
        ends.clear()

    yield device, plug, unplug
    unplug()


def test_serial_carries_every_byte_both_ways(ear, line):
    device, plug, _ = line
    master = plug()
    link = ear.open(f"serial://{device}:921600")
    every = bytes(range(256))
    os.write(master, every)
    until(lambda: len(ear.bytes) == 256)
    link.send(every)
    got = b""
    while len(got) < 256:
        got += os.read(master, 300)
    assert ear.bytes == got == every and link.stats.connected and link.stats.peer == str(device)


def test_serial_unplugged_and_plugged_in_again(ear, line):
    device, plug, unplug = line
    plug()
    link = ear.open(f"serial://{device}:57600")
    unplug()
    until(lambda: not link.stats.connected)
    link.send(b"lost")
    assert link.stats.dropped == 1 and "trying again" in link.stats.trouble
    master = plug()
    until(lambda: link.stats.connected)
    os.write(master, b"back")
    until(lambda: ear.bytes == b"back")
    assert link.stats.reconnects == 1 and ear.reports[-1].endswith(": connected")


def test_serial_missing_at_the_start_is_waited_for(ear, line):
    device, plug, _ = line
    link = ear.open(f"serial://{device}:921600")
    assert not link.stats.connected and "No such file" in link.stats.trouble
    plug()
    until(lambda: link.stats.connected)


def test_a_serial_device_belongs_to_one_program(ear, line):
    device, plug, _ = line
    plug()
    ear.open(f"serial://{device}:921600")
    with pytest.raises(LinkError, match="another program uses"):
        ear.open(f"serial://{device}:921600")


# --- all --------------------------------------------------------------------------------


def test_closing_ends_the_thread_and_sending_then_is_harmless(ear):
    threads = threading.active_count()
    link = ear.open(f"tcp://127.0.0.1:{free_port(socket.SOCK_STREAM)}")
    link.close()
    link.close()
    link.send(BEAT)
    assert threading.active_count() == threads and link.stats.dropped == 1


def test_closing_from_the_callback(peer):
    port, talker, links, done = free_port(), peer(), [], threading.Event()

    def take(data, stamp_ns):
        links[0].close()
        done.set()

    threads = threading.active_count()
    links.append(open_link(f"udpin://127.0.0.1:{port}", take, clock=time.monotonic_ns))
    talker.sendto(BEAT, ("127.0.0.1", port))
    assert done.wait(5)
    until(lambda: threading.active_count() == threads)
    open_link(f"udpin://127.0.0.1:{port}", take, clock=time.monotonic_ns).close()  # the port is free again


def test_sending_from_a_report_does_not_lock_up(ear, peer):
    port, talker, links = free_port(), peer(), []
    with open_link(
        f"udpin://127.0.0.1:{port}", ear.take, clock=ear.clock, report=lambda text: links[0].send(b"hi")
    ) as link:
        links.append(link)
        talker.sendto(BEAT, ("127.0.0.1", port))
        assert talker.recv(100) == b"hi"


def test_the_outbox_keeps_the_newest_and_never_cuts_a_frame():
    box, traffic, sent = Outbox(limit=30), Traffic(), []

    def write(data, size=4):
        sent.append(data[:size])
        return min(size, len(data))

    def once(data):
        if sent:
            raise BlockingIOError
        return write(data)

    assert box.push(b"a" * 10) == 0
    box.flush(once, traffic)  # a begun frame stays
    dropped = sum(box.push(bytes([c]) * 10) for c in b"bcdef")
    box.flush(write, traffic)
    assert dropped == 3 and b"".join(sent) == b"a" * 10 + b"e" * 10 + b"f" * 10
    assert (traffic.bytes_out, traffic.datagrams_out, box.size) == (30, 3, 0)
