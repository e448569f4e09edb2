"""Every wrong mission file ends in one line: file, line, field, what is wrong, what is valid."""

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.errors import InputError
from companion.mission.model import parse_mission

HEAD = "version: 1\nname: bad\n"
UP = "  - {do: takeoff, alt: 2}\n"
DOWN = "  - {do: land}\n"


def flown(*steps: str, head: str = HEAD) -> str:
    return head + "steps:\n" + UP + "".join(f"  - {step}\n" for step in steps) + DOWN


SQUARE = "[[-5, -5], [5, -5], [5, 5], [-5, 5]]"
FENCE = f"geofence: {{inside: {SQUARE}, alt: [-2, 8]}}\n"

# text, line, field, words of the message (problem and valid choices)
BAD = {
    "empty": ("", 1, "", ["empty"]),
    "only a comment": ("# nothing\n", 1, "", ["empty"]),
    "a list": ("- 1\n- 2\n", 1, "", ["a list of 2 is not a mapping", "version", "steps"]),
    "a word": ("hello\n", 1, "", ["hello is not a mapping"]),
    "a tab": (HEAD + "steps:\n\t- {do: land}\n", 4, "", ["tab", "spaces"]),
    "an open bracket": (HEAD + "steps: [\n", 4, "", ["not valid YAML"]),
    "a colon too many": (HEAD + "defaults: speed: 2\n", 3, "", ["not valid YAML"]),
    "two documents": (flown() + "---\na: 1\n", 6, "", ["second document", "one document"]),
    "an anchor": (HEAD + "steps: &a []\n", 3, "", ["anchors and aliases are not allowed", "a"]),
    "a python tag": (HEAD + "steps: !!python/object:os.system []\n", 3, "", ["tags are not allowed"]),
    "a key twice": (HEAD + "name: again\nsteps: []\n", 3, "name", ["given twice", "line 2", "once"]),
    "no steps": (HEAD, 1, "steps", ["is missing", "takeoff", "land"]),
    "no step at all": (HEAD + "steps: []\n", 3, "steps", ["0 items", "1 to 500"]),
    "wrong version": ("version: 2\nname: a\nsteps: []\n", 1, "version", ["2 is not a choice", "valid: 1"]),
    "bad name": ("version: 1\nname: My Flight\nsteps: []\n", 2, "name", ["'My Flight'", "^[a-z]"]),
    "name is a number": ("version: 1\nname: 12\nsteps: []\n", 2, "name", ["12 is not text", "quotes"]),
    "unknown top key": (
        HEAD + "product: {}\nsteps: []\n",
        3,
        "product",
        ["unknown key", "failsafe", "steps"],
    ),
    "design key not built": (HEAD + "products: {}\nsteps: []\n", 3, "products", ["unknown key"]),
    "unknown verb": (
        flown("{do: orbit}"),
        5,
        "steps[1].do",
        ["'orbit'", "takeoff", "goto", "survey", "land"],
    ),
    "verb with a slip": (flown("{do: gotto, at: [1, 2, 3]}"), 5, "steps[1].do", ["did you mean goto?"]),
    "no verb": (flown("{at: [1, 2, 3]}"), 5, "steps[1].do", ["is missing", "goto"]),
    "step is text": (flown("land"), 5, "steps[1]", ["land is not a mapping", "do: "]),
    "unknown step key": (
        flown("{do: goto, too: [1, 2, 3]}"),
        5,
        "steps[1].too",
        ["unknown key", "at", "frame"],
    ),
    "key not built": (flown("{do: hover, seconds: 2, max_energy: 1}"), 5, "steps[1].max_energy", ["unknown"]),
    "no place": (flown("{do: goto}"), 5, "steps[1].at", ["is missing", "3", "number", "in m"]),
    "two numbers": (flown("{do: goto, at: [1, 2]}"), 5, "steps[1].at", ["got a list of 2", "a list of 3"]),
    "a unit": (
        flown('{do: goto, at: [1, 2, "3 m"]}'),
        5,
        "steps[1].at[2]",
        ["'3 m' is not a number", "in m"],
    ),
    "a quoted number": (
        flown("{do: hover, seconds: '3'}"),
        5,
        "steps[1].seconds",
        ["without quotes", "in s"],
    ),
    "yes as a number": (flown("{do: hover, seconds: yes}"), 5, "steps[1].seconds", ["yes is not a number"]),
    "true as a number": (
        flown("{do: hover, seconds: true}"),
        5,
        "steps[1].seconds",
        ["true is not a number"],
    ),
    "not a number": (flown("{do: hover, seconds: .nan}"), 5, "steps[1].seconds", ["not finite"]),
    "infinite": (flown("{do: goto, at: [.inf, 0, 2]}"), 5, "steps[1].at[0]", ["not finite"]),
    "overflow": (flown("{do: goto, at: [1e999, 0, 2]}"), 5, "steps[1].at[0]", ["not finite"]),
    "sexagesimal": (flown("{do: hover, seconds: 1:30}"), 5, "steps[1].seconds", ["is not a number"]),
    "negative time": (
        flown("{do: hover, seconds: -1}"),
        5,
        "steps[1].seconds",
        ["out of range", "> 0", "in s"],
    ),
    "too far": (flown("{do: goto, at: [9000, 0, 2]}"), 5, "steps[1].at[0]", ["out of range", "<= 5000"]),
    "unknown frame": (flown("{do: goto, at: [1, 2, 3], frame: geo}"), 5, "steps[1].frame", ["home", "body"]),
    "yaw in degrees": (flown("{do: goto, at: [1, 2, 2], yaw: 90}"), 5, "steps[1].yaw", ["hold", "in rad"]),
    "yaw a slip": (
        flown("{do: goto, at: [1, 2, 2], yaw: along}"),
        5,
        "steps[1].yaw",
        ["along_path", "in rad"],
    ),
    "not a bool": (
        flown("{do: goto, at: [1, 2, 2], fly_through: yes}"),
        5,
        "steps[1].fly_through",
        ["true, false"],
    ),
    "bad id": (flown("{do: hover, seconds: 1, id: 1st}"), 5, "steps[1].id", ["1st is not allowed"]),
    "empty value": (flown("{do: hover, seconds: }"), 5, "steps[1].seconds", ["is not a number", "in s"]),
    "fence left empty": (HEAD + "geofence:\nsteps: []\n", 3, "geofence", ["is not a mapping", "inside"]),
    "limit too high": (
        flown("{do: hover, seconds: 1, limits: {speed: 99}}"),
        5,
        "steps[1].limits.speed",
        ["m/s"],
    ),
    "unknown of unknown": (
        HEAD + "defaults: {unknown: stop}\nsteps: []\n",
        3,
        "defaults.unknown",
        ["stop_before", "blocked"],
    ),
    "band upside down": (
        flown(head=HEAD + "defaults: {agl: [5, 1]}\n"),
        3,
        "defaults.agl",
        ["is not a band"],
    ),
    "takeoff below the band": (
        flown(head=HEAD + "defaults: {agl: [3, 6]}\n"),
        5,
        "steps[0].alt",
        ["2 is outside the agl band", "3 to 6 m"],
    ),
    "survey above the band": (
        flown(f"{{do: survey, area: {SQUARE}, spacing: 3, agl: 40}}"),
        5,
        "steps[1].agl",
        ["40 is outside", "0.8 to 30 m"],
    ),
    "goal above the band": (
        flown("{do: goto, at: [1, 1, 50], alt_ref: agl}"),
        5,
        "steps[1].at[2]",
        ["50 is outside", "agl"],
    ),
    "no takeoff": (HEAD + "steps:\n  - {do: land}\n", 4, "steps[0].do", ["begins with a takeoff", "takeoff"]),
    "two takeoffs": (flown("{do: takeoff, alt: 3}"), 5, "steps[1].do", ["already flying"]),
    "stays in the air": (
        HEAD + "steps:\n" + UP + "  - {do: hover, seconds: 3}\n",
        5,
        "steps[1].do",
        ["in the air", "land, or return_home"],
    ),
    "flies after landing": (flown("{do: return_home}"), 5, "steps[1].do", ["nothing can follow a landing"]),
    "an id twice": (
        flown("{do: hover, seconds: 1, id: a}", "{do: hover, seconds: 1, id: a}"),
        6,
        "steps[2].id",
        ["a is taken by line 5"],
    ),
    "crossed polygon": (
        flown("{do: survey, area: [[0, 0], [9, 9], [9, 0], [0, 9]], spacing: 2}"),
        5,
        "steps[1].area[2]",
        ["edge 2 crosses edge 0", "without crossing"],
    ),
    "flat polygon": (
        flown("{do: survey, area: [[0, 0], [9, 0], [4, 0.1]], spacing: 2}"),
        5,
        "steps[1].area",
        ["0.45 m2", "at least 1 m2"],
    ),
    "two corners": (
        flown("{do: survey, area: [[0, 0], [9, 9]], spacing: 2}"),
        5,
        "steps[1].area",
        ["2 items", "3 to 200"],
    ),
    "too many lanes": (
        flown(f"{{do: survey, area: {SQUARE}, spacing: 0.01}}"),
        5,
        "steps[1].spacing",
        ["1000 lanes", "more than 200", "0.05"],
    ),
    "retries without retry": (
        flown("{do: goto, at: [1, 1, 2], on_fail: {do: skip, retries: 3}}"),
        5,
        "steps[1].on_fail.retries",
        ["means nothing with do: skip", "do: retry"],
    ),
    "unknown action": (
        flown("{do: goto, at: [1, 1, 2], on_fail: {do: disarm}}"),
        5,
        "steps[1].on_fail.do",
        ["disarm", "return_home", "land_here"],
    ),
    "takeoff skipped": (
        HEAD + "steps:\n  - {do: takeoff, alt: 2, on_fail: {do: skip}}\n" + DOWN,
        4,
        "steps[0].on_fail",
        ["cannot be skipped"],
    ),
    "limits on landing": (
        HEAD + "steps:\n" + UP + "  - {do: land, limits: {speed: 1}}\n",
        5,
        "steps[1].limits",
        ["lands with its own limits"],
    ),
    "goal outside the fence": (
        flown("{do: goto, at: [9, 0, 2]}", head=HEAD + FENCE),
        6,
        "steps[1].at",
        ["4.0 m outside the fence", "line 3"],
    ),
    "path outside the fence": (
        flown("{do: follow_path, points: [[1, 0, 2], [0, 0, 9]]}", head=HEAD + FENCE),
        6,
        "steps[1].points[1]",
        ["1.0 m outside the fence"],
    ),
    "home outside the fence": (
        flown(head=HEAD + "geofence: {inside: [[5, 5], [9, 5], [9, 9]], alt: [-2, 8]}\n"),
        3,
        "geofence",
        ["the takeoff lies outside"],
    ),
    "fence with a floor above ground": (
        flown(head=HEAD + f"geofence: {{inside: {SQUARE}, alt: [0.3, 8]}}\n"),
        3,
        "geofence.alt[0]",
        ["0.3", "-0.5 or less"],
    ),
    "reserve in percent": (
        flown(head=HEAD + "failsafe: {battery: {reserve: 25}}\n"),
        3,
        "failsafe.battery.reserve",
        ["25 is out of range", "<= 1"],
    ),
    "no time": (
        flown("{do: hover, seconds: 60}", head=HEAD + "failsafe:\n  time_limit_s: 30\n"),
        4,
        "failsafe.time_limit_s",
        ["30 is too short", "more than"],
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_mission(name):
    text, line, field, words = BAD[name]
    with pytest.raises(InputError) as caught:
        parse_mission(text, file="m.yaml")
    error, message = caught.value, str(caught.value)
    assert error.exit_code == 2
    assert "\n" not in message
    assert message.startswith(f"m.yaml:{line}: "), message
    assert error.field == field
    for word in words:
        assert word in message, message


def test_every_class_of_mistake_is_here():
    assert len(BAD) >= 60


def test_deep_nesting_is_refused():
    with pytest.raises(InputError, match="nested too deeply"):
        parse_mission(HEAD + "steps: " + "[" * 2000 + "]" * 2000, file="m.yaml")


def test_a_huge_file_is_refused():
    with pytest.raises(InputError, match="at most 1000000"):
        parse_mission("#" * 1_000_001, file="m.yaml")


def test_control_characters_are_refused_with_their_line():
    with pytest.raises(InputError, match=re.escape("m.yaml:2: ")):
        parse_mission("version: 1\nname: a\x00b\n", file="m.yaml")


VALID = flown(f"{{do: survey, id: s, area: {SQUARE}, spacing: 3, on_fail: {{do: retry, retries: 2}}}}")


@settings(max_examples=120, deadline=None)
@given(st.integers(0, len(VALID) - 1), st.sampled_from(list("{}[],:-&*!|>'\"#%@`\t\n 0azé\x00")), st.booleans())
def test_one_changed_character_never_gives_anything_but_an_input_error(where, character, insert):
    text = VALID[:where] + character + VALID[where + (0 if insert else 1) :]
    try:
        parse_mission(text, file="m.yaml")
    except InputError as error:
        assert str(error).startswith("m.yaml:")


@settings(max_examples=60, deadline=None)
@given(st.text(max_size=60))
def test_any_text_gives_an_input_error(text):
    with pytest.raises(InputError, match=r"m\.yaml:"):
        parse_mission(text, file="m.yaml")
