"""What QGroundControl asks at its start, by pymavlink, beside a second client on the other endpoint.

Source of the sequence: QGroundControl's InitialConnectStateMachine (version, standard modes, component
metadata, parameters, mission, geofence, rally).
"""

import signal
import time

import pytest
from pymavlink import mavutil

ALL_DIALECTS = "all"  # AVAILABLE_MODES and CURRENT_MODE are in no smaller one
VERSION, AVAILABLE_MODES, CURRENT_MODE, METADATA = 148, 435, 436, 397
REQUEST_MESSAGE = 512
ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3
NAK, LIST_DIRECTORY = 129, 3


class Station:
    """A ground station's socket, with the messages that it has heard."""

    def __init__(self, port, *, system):
        self.link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=system, source_component=190)
        self.mav = self.link.mav
        assert self.link.wait_heartbeat(timeout=60)

    def ask(self, send, kind, accept=lambda m: True, tries=5):
        """Send, and wait for the answer; again, as every client does, if it did not come."""
        for _ in range(tries):
            send()
            end = time.monotonic() + 3.0
            while time.monotonic() < end:
                message = self.link.recv_match(type=kind, blocking=True, timeout=0.5)
                if message is not None and accept(message):
                    return message
        pytest.fail(f"no {kind}")

    def command(self, number, *params):
        values = [*params, *[0.0] * (7 - len(params))]
        return self.ask(
            lambda: self.mav.command_long_send(1, 1, number, 0, *values),
            "COMMAND_ACK",
            lambda m: m.command == number and m.target_system == self.mav.srcSystem,
        ).result


@pytest.fixture(scope="module")
def stations(start_sim):
    sim, before = start_sim("--gps"), mavutil.current_dialect
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MAVLINK20", "1")
        mavutil.set_dialect(ALL_DIALECTS)
        ground, other = Station(sim.gcs, system=255), Station(sim.mavlink, system=245)
        yield ground, other, sim
        ground.link.close()
        other.link.close()
    mavutil.set_dialect(before)


def test_version_with_the_capabilities_that_a_ground_station_looks_for(stations):
    ground, *_ = stations
    version = ground.ask(lambda: ground.mav.command_long_send(1, 1, 512, 0, VERSION, *[0] * 6), "AUTOPILOT_VERSION")
    flags = mavutil.mavlink
    for flag in (flags.MAV_PROTOCOL_CAPABILITY_MISSION_INT, flags.MAV_PROTOCOL_CAPABILITY_MAVLINK2,
                 flags.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE):  # fmt: skip
        assert version.capabilities & flag
    assert version.flight_sw_version >> 24 == 1


def test_modes_one_by_one_and_the_current_one(stations):
    ground, *_ = stations
    first = ground.ask(lambda: ground.mav.command_long_send(1, 1, 512, 0, AVAILABLE_MODES, 1, *[0] * 5),
                       "AVAILABLE_MODES")  # fmt: skip
    modes = {first.mode_index: first}
    for index in range(2, first.number_modes + 1):
        modes[index] = ground.ask(
            lambda n=index: ground.mav.command_long_send(1, 1, 512, 0, AVAILABLE_MODES, n, *[0] * 5),
            "AVAILABLE_MODES",
            lambda m, n=index: m.mode_index == n,
        )
    assert {m.mode_name for m in modes.values()} >= {"offboard", "hold", "land", "return", "takeoff", "mission"}
    current = ground.ask(lambda: ground.mav.command_long_send(1, 1, 512, 0, CURRENT_MODE, *[0] * 6), "CURRENT_MODE")
    assert current.custom_mode in {m.custom_mode for m in modes.values()}


def test_what_is_not_there_is_said_at_once(stations):
    ground, *_ = stations
    assert ground.command(REQUEST_MESSAGE, METADATA) in (DENIED, UNSUPPORTED)
    asked = [7, 0, 0, LIST_DIRECTORY, 1, 0, 0, 0, 0, 0, 0, 0, ord("/"), *[0] * 238]
    started = time.monotonic()
    answer = ground.ask(lambda: ground.mav.file_transfer_protocol_send(0, 1, 1, asked), "FILE_TRANSFER_PROTOCOL")
    assert answer.payload[3] == NAK
    assert answer.target_system == 255
    assert time.monotonic() - started < 15.0  # tries of its own would take a client longer


def test_parameters_come_whole_and_the_missing_ones_when_asked_for(stations):
    ground, *_ = stations
    found = {}

    def collect(m):
        found[m.param_index] = m.param_id
        return len(found) == m.param_count

    ground.ask(lambda: ground.mav.param_request_list_send(1, 1), "PARAM_VALUE", collect)
    assert sorted(found) == list(range(len(found)))
    one = ground.ask(
        lambda: ground.mav.param_request_read_send(1, 1, b"", 5), "PARAM_VALUE", lambda m: m.param_index == 5
    )
    assert one.param_id == found[5]


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_mission_fence_and_rally_lists_are_empty_and_say_of_which_kind_they_are(stations, kind):
    ground, *_ = stations
    count = ground.ask(lambda: ground.mav.mission_request_list_send(1, 1, kind), "MISSION_COUNT",
                       lambda m: m.mission_type == kind)  # fmt: skip
    assert (count.count, count.target_system, count.target_component) == (0, 255, 190)


def test_both_endpoints_hear_the_telemetry_and_each_gets_its_own_answers(stations):
    ground, other, _ = stations
    for station in (ground, other):
        for kind in ("SYS_STATUS", "GLOBAL_POSITION_INT", "ATTITUDE", "EXTENDED_SYS_STATE", "HOME_POSITION"):
            assert station.link.recv_match(type=kind, blocking=True, timeout=30), kind
    assert ground.command(REQUEST_MESSAGE, VERSION) == ACCEPTED
    assert other.command(REQUEST_MESSAGE, VERSION) == ACCEPTED
    stamp = 123456
    answers = [s.ask(lambda s=s: s.mav.timesync_send(0, stamp + s.mav.srcSystem), "TIMESYNC",
                     lambda m, s=s: m.ts1 == stamp + s.mav.srcSystem) for s in (ground, other)]  # fmt: skip
    assert all(m.tc1 > 0 for m in answers)


def test_it_ends_at_a_signal_with_a_summary(stations):
    *_, sim = stations
    summary = sim.end(signal.SIGTERM)
    assert summary["world"] == "empty"
    assert summary["contact"] == ""
    assert summary["simulated_s"] > 0.0
