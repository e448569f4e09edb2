"""Places as the items of a stored mission."""

import math

from companion.autopilot.mission_items import CHANGE_SPEED, DELAY, LAND, RETURN, TAKEOFF, WAYPOINT, described
from companion.mission.on_earth import Place
from companion.runtime.ports.mission_transfer import items_of

HERE = (math.nan, math.nan, math.nan)
PLACES = [
    Place("takeoff", 47.0, 8.0, 3.0, 2.0),
    Place("fly", 47.00001, 8.00002, 4.0, 2.0),
    Place("fly", 47.00002, 8.00002, 4.0, 1.0),
    Place("hover", *HERE, 1.0, 5.0),
    Place("land", *HERE, 2.0),
]


def test_a_speed_is_said_when_it_changes_and_before_the_way_that_has_it():
    items = items_of(PLACES)
    assert [i.command for i in items] == [TAKEOFF, CHANGE_SPEED, WAYPOINT, CHANGE_SPEED, WAYPOINT, DELAY, LAND]
    assert [i.params[1] for i in items if i.command == CHANGE_SPEED] == [2.0, 1.0]


def test_places_keep_seven_digits_and_a_landing_is_where_the_last_place_is():
    takeoff, _, first, _, last, hover, land = items_of(PLACES)
    assert (takeoff.x, takeoff.y, takeoff.z) == (470_000_000, 80_000_000, 3.0)
    assert (first.x, first.y) == (470_000_100, 80_000_200)
    assert (land.x, land.y, land.z) == (last.x, last.y, 0.0)
    assert hover.params[0] == 5.0


def test_a_return_needs_no_place_and_items_are_told_in_words():
    items = items_of([*PLACES[:2], Place("return", *HERE, 2.0)])
    assert items[-1].command == RETURN
    assert [described(i) for i in items] == [
        "take off 47.0000000, 8.0000000, 3 m up", "speed 2 m/s", "fly to 47.0000100, 8.0000200, 4 m up", "return",
    ]  # fmt: skip
