"""MAVSDK as it comes from PyPI flies `companion sim`."""

import math

import pytest

mavsdk = pytest.importorskip("mavsdk", reason="MAVSDK is an extra: pip install 'understory[mavsdk]'")

from mavsdk.plugins.action import Action, ActionError  # noqa: E402
from mavsdk.plugins.mission.mission import Mission, MissionItem, MissionPlan  # noqa: E402
from mavsdk.plugins.mission_raw.mission_raw import MissionRaw  # noqa: E402
from mavsdk.plugins.offboard.offboard import (  # noqa: E402
    Offboard,
    PositionNedYaw,
    VelocityBodyYawspeed,
    VelocityNedYaw,
)
from mavsdk.plugins.param.param import Param  # noqa: E402
from mavsdk.plugins.telemetry import FlightMode, LandedState, Telemetry  # noqa: E402

from companion.mission.model import parse_mission  # noqa: E402
from companion.mission.on_earth import Origin, places_of  # noqa: E402
from companion.runtime.ports.mission_transfer import MissionTransfer, items_of  # noqa: E402

EARTH_M = 6371000.0
SPEED = 2.0  # simulated seconds per second


class Client:
    """One MAVSDK instance with its plug-ins on one vehicle."""

    def __init__(self, port, until):
        kind = mavsdk.Configuration.create_with_component_type(mavsdk.ComponentType.GROUND_STATION)
        self.sdk, self.until = mavsdk.Mavsdk(kind), until
        self.sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        self.system = self.sdk.first_autopilot(30.0)
        self.action, self.telemetry = Action(self.system), Telemetry(self.system)
        self.mission_raw = MissionRaw(self.system)
        self.offboard, self.mission, self.param = Offboard(self.system), Mission(self.system), Param(self.system)

    @property
    def ned(self):
        p = self.telemetry.position_velocity_ned().position
        return p.north_m, p.east_m, -p.down_m

    @property
    def speed(self):
        v = self.telemetry.position_velocity_ned().velocity
        return v.north_m_s, v.east_m_s, -v.down_m_s

    def at(self, place, within_m=1.0):
        return math.dist(self.ned, place) < within_m

    def take_off(self, height_m=4.0):
        self.until(lambda: self.telemetry.health().is_armable, "a vehicle that would arm")
        self.action.set_takeoff_altitude(height_m)
        low = self.ned[2]
        self.action.arm()
        self.action.takeoff()
        self.until(lambda: self.ned[2] > low + height_m - 0.7, "the height of take-off")
        self.until(lambda: self.telemetry.flight_mode() is FlightMode.HOLD, "hold after take-off")

    def wait_landed(self):
        self.until(lambda: self.telemetry.landed_state() is LandedState.ON_GROUND, "ground", 90.0)
        self.until(lambda: not self.telemetry.armed(), "motors off")


@pytest.fixture(scope="module")
def client(start_sim, until):
    sim = start_sim("--gps", speed=SPEED)
    client = Client(sim.mavlink, until)
    client.ground = f"udpin://127.0.0.1:{sim.gcs}"
    yield client
    client.sdk.destroy()
    summary = sim.end()
    assert summary["armed_s"] > 10.0
    assert summary["contact"] == ""


def test_it_finds_a_healthy_px4_multicopter(client, until):
    assert client.system.autopilot_type() == mavsdk.Autopilot.PX4
    until(client.telemetry.health_all_ok, "a healthy vehicle")
    assert client.telemetry.gps_info().num_satellites == 12
    assert client.telemetry.battery().remaining_percent > 50
    assert client.telemetry.home().latitude_deg == pytest.approx(47.397742, abs=1e-4)


def test_parameters_are_read_set_and_listed(client):
    assert client.param.get_param_int("SYS_HAS_GPS") == 1
    client.param.set_param_float("MPC_XY_CRUISE", 4.5)
    assert client.param.get_param_float("MPC_XY_CRUISE") == 4.5
    every = client.param.get_all_params()
    floats = {p.name: p.value for p in every.float_params}
    assert floats["MPC_XY_CRUISE"] == 4.5
    assert {p.name: p.value for p in every.int_params}["EKF2_EV_CTRL"] == 15
    assert len(every.float_params) + len(every.int_params) > 100


def test_take_off_goto_and_land(client, until):
    client.take_off()
    with pytest.raises(ActionError):
        client.action.takeoff()  # it flies already
    here, north_m = client.telemetry.position(), 8.0
    start = client.ned
    latitude = here.latitude_deg + math.degrees(north_m / EARTH_M)
    client.action.goto_location(latitude, here.longitude_deg, here.absolute_altitude_m + 1.0, 0.0)
    until(lambda: client.at((start[0] + north_m, start[1], start[2] + 1.0)), "the place on Earth")
    client.action.land()
    client.wait_landed()


@pytest.mark.slow
def test_offboard_by_velocity_and_position_then_return(client, until):
    client.take_off()
    home = client.ned
    client.offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0))
    client.offboard.start()
    client.offboard.set_velocity_ned(VelocityNedYaw(1.5, 0.0, 0.0, 0.0))
    until(lambda: client.speed[0] > 1.2, "1.5 m/s to the north")
    client.offboard.set_velocity_body(VelocityBodyYawspeed(0.0, 1.5, 0.0, 0.0))
    until(lambda: client.speed[1] > 1.2, "1.5 m/s to the right, which is east")
    goal = home[0] + 12.0, home[1] + 5.0, home[2] + 1.0
    client.offboard.set_position_ned(PositionNedYaw(goal[0], goal[1], -goal[2], 90.0))
    until(lambda: client.at(goal), "the place in the local frame")
    until(lambda: abs(client.telemetry.heading().heading_deg - 90.0) < 5.0, "nose to the east")
    client.offboard.stop()
    until(lambda: client.telemetry.flight_mode() is FlightMode.HOLD, "hold after offboard")
    client.action.return_to_launch()
    until(lambda: client.telemetry.flight_mode() is FlightMode.RETURN_TO_LAUNCH, "return")
    client.wait_landed()
    assert math.hypot(client.ned[0] - home[0], client.ned[1] - home[1]) < 2.0


@pytest.mark.slow
def test_a_mission_is_uploaded_read_back_and_flown_to_its_end(client, until):
    until(lambda: client.telemetry.health().is_armable, "a vehicle that would arm")
    home = client.telemetry.position()
    plan = MissionPlan([waypoint(home, *place) for place in ((6.0, 0.0, 4.0), (6.0, 6.0, 5.0), (0.0, 6.0, 4.0))])
    client.mission.set_return_to_launch_after_mission(True)
    client.mission.upload_mission(plan)
    back = client.mission.download_mission()
    assert [round(i.latitude_deg, 7) for i in back.mission_items] == [
        round(i.latitude_deg, 7) for i in plan.mission_items
    ]
    client.action.arm()
    client.mission.start_mission()
    until(lambda: client.telemetry.flight_mode() is FlightMode.MISSION, "mission mode")
    until(lambda: client.mission.mission_progress().current >= 1, "the first waypoint", 90.0)
    client.mission.pause_mission()
    until(lambda: client.telemetry.flight_mode() is FlightMode.HOLD, "hold")
    client.mission.start_mission()
    until(client.mission.is_mission_finished, "the end of the mission", 120.0)
    client.wait_landed()


@pytest.mark.slow
def test_our_own_mission_is_stored_by_the_companion_and_flown_where_it_says(client, until):
    until(lambda: client.telemetry.health().is_armable, "a vehicle that would arm")
    home, here = client.telemetry.position(), client.ned
    steps = "[{do: takeoff, alt: 4}, {do: goto, at: [8, 3, 5]}, {do: hover, seconds: 2}, {do: land}]"
    text = f"version: 1\nname: m\nsteps: {steps}"
    origin = Origin(home.latitude_deg, home.longitude_deg, 90.0)  # x points to the east, y to the north
    with MissionTransfer(client.ground) as transfer:
        transfer.upload(items_of(places_of(parse_mission(text, file="m"), origin)))
    client.action.arm()
    client.mission_raw.start_mission()
    until(lambda: client.at((here[0] + 3.0, here[1] + 8.0, here[2] + 5.0)), "the place in the mission", 90.0)
    client.wait_landed()
    assert math.hypot(client.ned[0] - here[0] - 3.0, client.ned[1] - here[1] - 8.0) < 1.5


def waypoint(home, north_m, east_m, up_m):
    nan = math.nan
    east_deg = math.degrees(east_m / (EARTH_M * math.cos(math.radians(home.latitude_deg))))
    return MissionItem(
        home.latitude_deg + math.degrees(north_m / EARTH_M), home.longitude_deg + east_deg, up_m, 3.0, True, nan, nan,
        MissionItem.CameraAction.NONE, nan, nan, 1.0, nan, nan, MissionItem.VehicleAction.NONE,
    )  # fmt: skip
