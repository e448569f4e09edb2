import json
import math
from typing import Annotated, Literal

import msgspec
import pytest
import typer
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from companion.cli import config as cli
from companion.config import (
    Config,
    apply_overrides,
    apply_overrides_to,
    dump_config,
    dump_struct,
    load_config,
)
from companion.config.dump import field_docs
from companion.core.errors import InputError
from companion.core.strict_yaml import load_strict
from companion.mission.config import MissionConfig
from companion.safety.assess import SafetyConfig


class Leaf(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What is at the end."""

    size_m: Annotated[float, msgspec.Meta(ge=0)] = 1.0  # of the leaf
    # before it stands a comment
    colour: str = "green"
    plain: int = 3
    """A string of
    two lines."""


class Tree(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """All kinds of values."""

    text: str = ""
    number: float = 0.0
    whole: int = 0
    flag: bool = False
    choice: Literal["a", "b"] = "a"
    maybe: float | None = None
    points: tuple[tuple[float, float], ...] = ()
    delays: dict[str, dict[str, float]] = msgspec.field(default_factory=dict)
    leaf: Leaf = Leaf()
    leaves: tuple[Leaf, ...] = ()


numbers = st.floats(allow_nan=False, allow_infinity=False)
names = st.text(st.characters(exclude_categories=["C"]), max_size=12)
leaves = st.builds(Leaf, size_m=st.floats(0, 1e300), colour=names, plain=st.integers(-(10**18), 10**18))
trees = st.builds(
    Tree, text=names, number=numbers, whole=st.integers(-(10**18), 10**18), flag=st.booleans(),
    choice=st.sampled_from("ab"), maybe=st.none() | numbers,
    points=st.lists(st.tuples(numbers, numbers), max_size=3).map(tuple),
    delays=st.dictionaries(names, st.dictionaries(names, numbers, max_size=2), max_size=2),
    leaf=leaves, leaves=st.lists(leaves, max_size=2).map(tuple),
)  # fmt: skip


@settings(max_examples=100, deadline=None)
@given(trees)
def test_what_is_dumped_reads_back_equal(tree):
    text = dump_struct(tree)
    assert load_strict(text, Tree, file="t") == tree
    below = load_strict(dump_struct(tree, root="tree"), dict[str, Tree], file="t")
    assert below == {"tree": tree}


@settings(max_examples=50, deadline=None)
@given(trees)
def test_other_yaml_readers_take_the_dump_for_the_same_values(tree):
    assert msgspec.convert(yaml.safe_load(dump_struct(tree)), Tree) == tree


def test_comments_come_from_the_sources():
    assert field_docs(Leaf) == {
        "size_m": "of the leaf",
        "colour": "before it stands a comment",
        "plain": "A string of two lines.",
    }
    assert "# of the leaf [a number >= 0 in m]\n  size_m: 1.0" in dump_struct(Tree())


def test_the_whole_configuration_reads_back_equal():
    assert load_config(dump_config(Config()), file="c") == Config()


def test_a_changed_configuration_reads_back_equal():
    """Each number changed by a little, where its range allows."""
    config, changed = Config(), 0
    for path, value in numeric_leaves(config):
        try:
            config = apply_overrides(config, [f"{path}={value * 1.0625 if isinstance(value, float) else value + 1}"])
        except InputError:
            continue
        changed += 1
    assert changed > 60
    assert load_config(dump_config(config), file="c") == config


def numeric_leaves(struct, prefix=""):
    for name in struct.__struct_fields__:
        value = getattr(struct, name)
        if isinstance(value, msgspec.Struct):
            yield from numeric_leaves(value, f"{prefix}{name}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield f"{prefix}{name}", value


def test_every_number_of_the_configuration_is_finite_and_explained():
    for path, value in numeric_leaves(Config()):
        assert math.isfinite(value), path
    assert list(unexplained(MissionConfig())) + list(unexplained(SafetyConfig())) == []


def unexplained(struct, prefix=""):
    docs = field_docs(type(struct))
    for name in struct.__struct_fields__:
        value = getattr(struct, name)
        if isinstance(value, msgspec.Struct):
            yield from unexplained(value, f"{prefix}{name}.")
        elif not docs.get(name):
            yield prefix + name


def test_overrides_change_what_they_name_and_nothing_else():
    config = apply_overrides(Config(), ["mission.hold_s=5", "safety.slow_scale=0.5", "mission.hold_s=7"])
    assert config.mission.hold_s == 7.0 and config.safety.slow_scale == 0.5
    assert apply_overrides(config, ["mission.hold_s=20", "safety.slow_scale=0.4"]) == Config()


def test_overrides_that_only_fit_together_are_applied_together():
    """`low <= high` must hold at the end, not in between."""

    class Band(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
        low: float = 0.0
        high: float = 1.0

        def __post_init__(self) -> None:
            if self.low > self.high:
                raise InputError("is above high", field="somewhere.low", valid=f"up to {self.high:g}")

    assert apply_overrides_to(Band(), ["low=5", "high=6"]) == Band(low=5.0, high=6.0)
    with pytest.raises(InputError, match=r"^low: is above high \(valid: up to 1\)$"):
        apply_overrides_to(Band(), ["low=5"])


def test_delays_are_set_by_node_and_topic():
    config = apply_overrides(Config(), ["lockstep.delay_ms.LioNode.sensors/lidar=40"])
    assert config.lockstep.delay_ms["LioNode"]["sensors/lidar"] == 40.0
    assert config.lockstep.delay_ms["MappingNode"] == Config().lockstep.delay_ms["MappingNode"]
    assert Config().lockstep.delay_ms["LioNode"]["sensors/lidar"] != 40.0


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("mission.hold=5", "mission.hold: unknown key, did you mean hold_s? (valid: ready_timeout_s,"),
        (
            "misson.hold_s=5",
            "misson: unknown key, did you mean mission? (valid: rig, hull_radius_m, sensors, estimation",
        ),
        ("mission.hold_s=-5", "mission.hold_s: -5 is out of range (valid: a number > 0 in s)"),
        ("mission.hold_s=5 s", "mission.hold_s: '5 s' is not a number"),
        ("mission.hold_s=", "mission.hold_s: has no value"),
        ("mission.hold_s=[", "mission.hold_s: '['"),
        ("mission.hold_s", "--set: 'mission.hold_s' is not an override (valid: path.to.key=value)"),
        ("mission.hold_s.x=5", "mission.hold_s: has no parts, it is 20.0"),
        ("mission=5", "mission: 5 is not a mapping"),
        ("lockstep.delay_ms.LidNode.a=5", "lockstep.delay_ms.LidNode: unknown key, did you mean LioNode?"),
        ("=5", "is not an override"),
        ("a..b=5", "is not an override"),
    ],
)
def test_wrong_overrides_say_what_would_be_right(override, message):
    with pytest.raises(InputError) as caught:
        apply_overrides(Config(), [override])
    assert message in str(caught.value)
    assert caught.value.exit_code == 2 and "\n" not in str(caught.value)


def test_files_hold_only_differences_and_errors_name_the_line():
    assert load_config("mission:\n  hold_s: 5\n", file="c").mission.hold_s == 5.0
    with pytest.raises(InputError, match=r"^c:2: mission\.hold_m: unknown key, did you mean hold_s\?"):
        load_config("mission:\n  hold_m: 5\n", file="c")


def test_dump_command_prints_yaml_or_json():
    app = typer.Typer()
    app.command()(cli.dump)
    result = CliRunner().invoke(app, ["--set", "mission.hold_s=5"])
    assert result.exit_code == 0
    assert load_config(result.stdout, file="c") == apply_overrides(Config(), ["mission.hold_s=5"])
    data = json.loads(CliRunner().invoke(app, ["--json"]).stdout)
    assert data["mission"]["hold_s"] == 20.0


def test_an_error_names_the_key_as_it_was_typed():
    with pytest.raises(InputError, match=r"sim\.ready_timeot_s"):
        apply_overrides_to(MissionConfig(), ["ready_timeot_s=2"], root="sim")
