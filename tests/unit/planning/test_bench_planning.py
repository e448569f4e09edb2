"""Rows of `companion bench planning` from traces whose figures are known."""

import math

import msgspec
import pytest

from companion.runtime.bench.planning_ompl import PEERS
from companion.runtime.bench.planning_rows import enclosed_row, world_rows


def traces(**own):
    """Two runs each, between ends whose shortest ways are 10 and 20 m."""
    slow = [(0, [(0.1, 12.0), (0.2, 10.1)]), (1, [(0.1, 24.0), (0.3, 20.2)])]
    return {"portfolio": own["ours"], "rrt_star": own["ours"], **{peer: slow for peer in PEERS}}


FAST = [(0, [(0.0002, 11.0), (0.004, 10.0)]), (1, [(0.0004, 21.0), (0.004, 20.0)])]


def by_gauge(rows):
    return {(row.gauge, row.planner): row for row in rows}


def test_forest_rows_compare_with_the_targets():
    rows = by_gauge(world_rows("forest_25", traces(ours=FAST), [10.0, 20.0]))
    assert rows["first_p50_ms", "portfolio"].value == pytest.approx(0.3)
    assert rows["first_p95_ms", "portfolio"].value == pytest.approx(0.4)
    assert rows["cost_ratio_5ms", "portfolio"].value == 1.0 and rows["cost_ratio_5ms", "portfolio"].met
    assert rows["success_50ms", "portfolio"].value == 1.0
    sooner = rows["times_sooner_at_1.02", "portfolio"]
    assert sooner.value == pytest.approx(250.0 / 4.0, rel=1e-4) and sooner.met


def test_hard_rows_are_not_met_by_a_planner_that_is_late():
    late = [(0, [(0.06, 10.2)]), (1, [(0.06, 20.0)])]
    rows = by_gauge(world_rows("maze", traces(ours=late), [10.0, 20.0]))
    assert rows["success_50ms", "portfolio"].value == 0.0 and not rows["success_50ms", "portfolio"].met
    assert rows["cost_ratio_20ms", "portfolio"].value is None
    assert rows["cost_ratio_100ms", "portfolio"].value == pytest.approx(1.01)
    assert not rows["cost_ratio_100ms", "portfolio"].met
    assert not rows["times_sooner_at_1.02", "portfolio"].met  # about four times sooner is not 25


def test_a_rival_that_never_comes_near_is_beaten():
    never = {peer: [(0, []), (1, [])] for peer in PEERS}
    rows = by_gauge(world_rows("maze", {**traces(ours=FAST), **never}, [10.0, 20.0]))
    sooner = rows["times_sooner_at_1.02", "portfolio"]
    assert sooner.met and sooner.value is None and "never" in sooner.note
    assert rows["ratio_less_RRTstar", "rrt_star"].met


def test_rrt_star_must_be_no_longer_at_every_checkpoint():
    worse_late = [(0, [(0.001, 10.05)]), (1, [(0.001, 20.1)])]
    better_late = {peer: [(0, [(0.3, 10.0)]), (1, [(0.3, 20.0)])] for peer in PEERS}
    rows = by_gauge(world_rows("forest_16", {**traces(ours=worse_late), **better_late}, [10.0, 20.0]))
    row = rows["ratio_less_RRTstar", "rrt_star"]
    assert not row.met and row.value == pytest.approx(0.005, rel=1e-3)


def test_rows_are_valid_json_without_the_peers_and_say_why():
    ours = {"portfolio": [(0, [])], "rrt_star": [(0, [])]}
    rows = world_rows("maze", ours, [10.0], skipped="the wheel is not there")
    assert rows[-1].note == "the wheel is not there"
    for row in rows:
        assert "Infinity" not in msgspec.json.encode(row).decode()
        assert row.value is None or math.isfinite(row.value)


def test_only_a_proof_in_a_second_meets_the_target():
    assert enclosed_row("infeasible", 20.0, 10.0).met
    assert not enclosed_row("infeasible", 1200.0, 10.0).met
    assert not enclosed_row("", 20.0, 10.0).met
