"""A mission's places on Earth, against distances on the ellipsoid."""

import math

import pytest

from companion.core.errors import InputError
from companion.mission.model import parse_mission
from companion.mission.on_earth import Origin, places_of, to_earth

ZURICH = Origin(47.3977, 8.5456, 0.0)
TEXT = """
version: 1
name: around
steps:
  - {do: takeoff, alt: 3.0}
  - {do: goto, at: [10, 4, 5], limits: {speed: 1.5}}
  - {do: hover, seconds: 7}
  - {do: %s}
"""


def moved_m(place, origin):
    """North and east, m, by the lengths of a degree at that latitude (WGS 84, series of NGA TR8350.2)."""
    phi = math.radians(origin.latitude_deg)
    per_degree_north = 111132.954 - 559.822 * math.cos(2 * phi) + 1.175 * math.cos(4 * phi)
    per_degree_east = 111412.84 * math.cos(phi) - 93.5 * math.cos(3 * phi) + 0.118 * math.cos(5 * phi)
    return (
        (place[0] - origin.latitude_deg) * per_degree_north,
        (place[1] - origin.longitude_deg) * per_degree_east,
    )


@pytest.mark.parametrize("latitude_deg", [-60.0, 0.0, 47.4, 80.0])
@pytest.mark.parametrize(
    ("heading_deg", "ahead", "left"),
    [(0, (1, 0), (0, -1)), (90, (0, 1), (1, 0)), (180, (-1, 0), (0, 1)), (-90, (0, -1), (-1, 0))],
)
def test_ahead_and_left_lie_where_the_compass_says(latitude_deg, heading_deg, ahead, left):
    origin = Origin(latitude_deg, 8.0, heading_deg)
    for xy, wanted in (((100.0, 0.0), ahead), ((0.0, 100.0), left)):
        assert moved_m(to_earth(*xy, origin), origin) == pytest.approx([100.0 * w for w in wanted], abs=0.01)


def test_every_step_has_its_place_its_height_and_its_speed():
    takeoff, there, hover, back = places_of(parse_mission(TEXT % "return_home", file="m"), ZURICH)
    assert (takeoff.do, takeoff.height_m) == ("takeoff", 3.0)
    assert (takeoff.latitude_deg, takeoff.longitude_deg) == (ZURICH.latitude_deg, ZURICH.longitude_deg)
    assert (there.do, there.height_m, there.speed) == ("fly", 5.0, 1.5)
    assert moved_m((there.latitude_deg, there.longitude_deg), ZURICH) == pytest.approx([10.0, -4.0], abs=0.01)
    assert (hover.do, hover.seconds) == ("hover", 7.0)
    assert back.do == "return"


def test_a_return_without_landing_is_a_place():
    back, land = places_of(parse_mission(TEXT % "return_home, land: none}\n  - {do: land", file="m"), ZURICH)[-2:]
    assert land.do == "land"
    assert (back.do, back.height_m) == ("fly", 3.0)
    assert (back.latitude_deg, back.longitude_deg) == (ZURICH.latitude_deg, ZURICH.longitude_deg)


@pytest.mark.parametrize("frame", ["map", "body"])
def test_a_frame_that_is_known_only_in_flight_has_no_place(frame):
    text = TEXT.replace("5], limits", f"5], frame: {frame}, limits") % "land"
    with pytest.raises(InputError, match=rf"goto_1.frame: frame {frame} is known only in flight .valid: home"):
        places_of(parse_mission(text, file="m"), ZURICH)


@pytest.mark.parametrize("origin", [Origin(91, 0, 0), Origin(0, 181, 0), Origin(0, 0, 361), Origin(math.nan, 0, 0)])
def test_an_origin_that_is_none_is_named(origin):
    with pytest.raises(InputError, match=r"origin: .* is no (latitude|longitude|heading)"):
        places_of(parse_mission(TEXT % "land", file="m"), origin)
