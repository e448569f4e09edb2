from typing import Annotated, Literal

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.errors import InputError
from companion.core.strict_yaml import load_strict, read_document


class Inner(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    low_m: float = 1.0
    high_m: float = 2.0

    def __post_init__(self) -> None:
        if self.low_m > self.high_m:
            raise ValueError(f"low_m {self.low_m:g} is above high_m {self.high_m:g}")


class Outer(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    speed_m_s: Annotated[float, msgspec.Meta(gt=0, le=20)] = 1.0
    count: Annotated[int, msgspec.Meta(ge=0)] = 3
    name: str = ""
    mode: Literal["slow", "fast"] = "slow"
    flag: bool = False
    maybe: float | None = None
    pair: tuple[float, int] = (0.5, 1)
    many: tuple[float, ...] = ()
    table: dict[str, dict[str, float]] = {}
    inner: Inner = Inner()


def load(text):
    return load_strict(text, Outer, file="f.yaml")


def refused(text):
    with pytest.raises(InputError) as caught:
        load(text)
    return str(caught.value)


def test_only_differences_are_needed():
    assert load("count: 7\n") == Outer(count=7)
    assert load("{}\n") == Outer()


def test_every_type_reads():
    text = """
speed_m_s: 1e1
count: 12
name: "0.5"
mode: fast
flag: true
maybe: null
pair: [-.5, +2]
many: [1, 2.0, 3.e-1]
table: {a: {b/c: 1}}
inner: {low_m: 0, high_m: 9}
"""
    expected = Outer(
        speed_m_s=10.0, count=12, name="0.5", mode="fast", flag=True, pair=(-0.5, 2), many=(1.0, 2.0, 0.3),
        table={"a": {"b/c": 1.0}}, inner=Inner(low_m=0.0, high_m=9.0),
    )  # fmt: skip
    assert load(text) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("speed_m_s: 21\n", "f.yaml:1: speed_m_s: 21 is out of range (valid: a number > 0 and <= 20 in m/s)"),
        ("speed_m_s: 3 m/s\n", "f.yaml:1: speed_m_s: '3 m/s' is not a number (valid: a number > 0"),
        ("count: 3.0\n", "f.yaml:1: count: 3.0 is not a whole number (valid: a whole number >= 0)"),
        ("count: 0x10\n", "count: 0x10 is not a number"),
        (f"count: {'9' * 30}\n", "is not a whole number"),
        ("mode: fst\n", "f.yaml:1: mode: fst is not a choice, did you mean fast? (valid: fast, slow)"),
        ("flag: no\n", "flag: no is not true or false (valid: true, false)"),
        ("flag: 'true'\n", "flag: 'true' is not true or false"),
        ("maybe: x\n", "maybe: x is not"),
        ("pair: [1, 2, 3]\n", "pair: got a list of 3 (valid: a list of 2: a number, a whole number)"),
        ("many: [1, {}]\n", "many[1]: a mapping is not a number"),
        ("table: {a: 1}\n", "table.a: 1 is not a mapping"),
        ("table: {a: {b: x}}\n", "table.a.b: x is not a number"),
        ("inner:\n  low_m: 3\n", "f.yaml:2: inner: low_m 3 is above high_m 2"),
        ("inner:\n  low: 3\n", "f.yaml:2: inner.low: unknown key, did you mean low_m? (valid: low_m, high_m)"),
        ("inner: []\n", "inner: a list of 0 is not a mapping (valid: a mapping with low_m, high_m)"),
        ("{[1]: 2}\n", "a list of 1 cannot be a key"),
        ("<<: {count: 1}\n", "<<: unknown key"),
        ("a: &x 1\nb: *x\n", "f.yaml:1: anchors and aliases are not allowed"),
        ("count: !!int 3\n---\n", "f.yaml:2: a second document begins here"),
        ("count: 1\n\tname: x\n", "f.yaml:2: a tab in the indentation (valid: spaces)"),
        ("count: 1\n name: x\n", "f.yaml:2: not valid YAML"),
    ],
)
def test_refusals_say_where_what_and_what_is_valid(text, message):
    assert message in refused(text)


def test_lines_of_missing_parts_are_those_of_their_parents():
    document = read_document("a:\n  - x: 1\n  -\n    y: 2\n", file="f")
    assert document.line_of(("a",)) == 1
    assert document.line_of(("a", 1, "y")) == 4
    assert document.line_of(("a", 0, "nothing", "there")) == 2
    assert document.line_of(("b",)) == 1


@settings(max_examples=80, deadline=None)
@given(st.floats(allow_nan=False, allow_infinity=False))
def test_a_number_reads_back_exactly(value):
    assert load(f"pair: [{value!r}, 0]\n").pair[0] == value


@settings(max_examples=80, deadline=None)
@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
        lambda deeper: st.lists(deeper, max_size=3) | st.dictionaries(st.text(max_size=8), deeper, max_size=3),
        max_leaves=8,
    )
)
def test_any_data_is_read_or_refused_in_one_line(data):
    import yaml

    try:
        load(yaml.safe_dump(data, allow_unicode=True))
    except InputError as error:
        assert str(error).startswith("f.yaml:") and "\n" not in str(error)
