"""The health of a live stack as ROS diagnostics: one status per node, process group and topic.

`rqt_runtime_monitor`, Foxglove and `companion top` read them. A status is what happened since the
last report, not since the start: a warning goes when its cause has gone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from companion.core import topics
from companion.core.node import Topic
from companion.runtime.pipes import Beat, NodeBeat
from companion.runtime.wire.parts import header_of

TYPE = "diagnostic_msgs/msg/DiagnosticArray"
OK, WARN, ERROR = 0, 1, 2
BUSY_S = 0.5  # with one event: longer than any node should need
Kind = Literal["node", "group", "topic"]


@dataclass(frozen=True, slots=True, kw_only=True)
class GroupReport:
    """What a supervisor knows of one process group."""

    group: str
    pid: int
    restarts: int
    down: str  # why it counts as down
    beat: Beat | None
    figures: dict[str, float] = field(default_factory=dict)
    figures_ns: int = 0  # when it told them: about once per second


class Diagnoses:
    """Turns reports into statuses; remembers the last ones, for rates."""

    def __init__(self, vehicle: str) -> None:
        self._vehicle = vehicle
        self._before: dict[str, GroupReport] = {}
        self._told: dict[str, GroupReport] = {}  # with the figures before the newest
        self._rates: dict[tuple[str, str], float] = {}  # (group, figure) -> per second, between the last two figures

    def array(self, reports: Sequence[GroupReport], now_ns: int) -> dict[str, Any]:
        """A value of diagnostic_msgs/msg/DiagnosticArray."""
        for report in reports:
            self._measure(report)
        statuses = [s for report in reports for s in self._of_group(report)]
        statuses += self._of_topics(reports)
        self._before = {r.group: r for r in reports}
        return {"header": header_of(now_ns, ""), "status": statuses}

    def _measure(self, report: GroupReport) -> None:
        """Rates of all figures, if there are new ones."""
        told = self._told.get(report.group)
        if told is not None and told.figures_ns == report.figures_ns and told.pid == report.pid:
            return
        before = told if told is not None and told.pid == report.pid else None
        span_s = (report.figures_ns - before.figures_ns) * 1e-9 if before and before.figures_ns else 0.0
        for key, figure in report.figures.items():
            grown = figure - before.figures.get(key, figure) if before else 0.0
            self._rates[report.group, key] = grown / span_s if span_s > 0 else 0.0
        self._told[report.group] = report

    def _of_group(self, report: GroupReport) -> Iterator[dict[str, Any]]:
        beat, before = report.beat, self._before.get(report.group)
        past = before.beat if before and before.pid == report.pid else None
        span_s = (beat.stamp_ns - past.stamp_ns) * 1e-9 if beat and past else 0.0
        lost = _grown(report.figures, before.figures if past and before else {}, "bus_lost")
        level, text = _first(
            (ERROR, f"down: {report.down}" if report.down else ""),
            (WARN, f"lost {lost:.0f} messages on the bus" if lost else ""),
            (WARN, "no link to the vehicle" if report.figures.get("link_connected") == 0.0 else ""),
            default=beat.state if beat else "starting",
        )
        values: dict[str, Any] = {"pid": report.pid, "restarts": report.restarts}
        if beat:
            values |= {"cpu_percent": _percent(beat.cpu_s, past.cpu_s if past else None, span_s)}
            values |= {"memory_mb": beat.memory_mb}
        values |= {k: v for k, v in report.figures.items() if " " not in k}
        yield self._status("group", report.group, level, text, values)
        nodes = {n.name: n for n in past.nodes} if past else {}
        for node in beat.nodes if beat else ():
            yield self._of_node(node, nodes.get(node.name), report, span_s)

    def _of_node(self, node: NodeBeat, past: NodeBeat | None, report: GroupReport, span_s: float) -> dict[str, Any]:
        late = node.late_ticks - past.late_ticks if past else 0
        refused = node.refused - past.refused if past else 0
        level, text = _first(
            (ERROR, f"down: {report.down}" if report.down else ""),
            (WARN, f"busy for {node.busy_s:.1f} s with one event" if node.busy_s > BUSY_S else ""),
            (WARN, f"{late} ticks left out: it was busy" if late else ""),
            (WARN, f"{refused} messages refused: they could not be decoded" if refused else ""),
            default=report.beat.state if report.beat else "starting",
        )
        values: dict[str, Any] = {
            "handled": node.handled,
            "handled_hz": (node.handled - past.handled) / span_s if past and span_s > 0 else 0.0,
            "ticks": node.ticks,
            "late_ticks": node.late_ticks,
            "worst_late_ms": 1e3 * node.worst_late_s,
            "dropped": node.dropped,
            "refused": node.refused,
            "waiting": node.waiting,
            "cpu_percent": _percent(node.cpu_s, past.cpu_s if past else None, span_s),
            "busy_s": node.busy_s,
            "restarts": report.restarts,
        }
        return self._status("node", f"{report.group}/{node.name}", level, text, values)

    def _of_topics(self, reports: Sequence[GroupReport]) -> Iterator[dict[str, Any]]:
        """Each topic once: as its publisher counts, or else as who hears it counts; who is down counts last."""
        up, down = [r for r in reports if not r.down], [r for r in reports if r.down]
        order = [(what, r) for those in (up, down) for what in ("published", "heard") for r in those]
        for topic in topics.ALL:
            found = next(((what, r) for what, r in order if f"{what} {topic.name}" in r.figures), None)
            if found is not None:
                yield self._of_topic(topic, *found)

    def _of_topic(self, topic: Topic[Any], what: str, report: GroupReport) -> dict[str, Any]:
        count, silence_s = report.figures[f"{what} {topic.name}"], report.figures[f"{what} silence {topic.name}"]
        rate_hz, allowed_s = self._rates.get((report.group, f"{what} {topic.name}"), 0.0), topic.deadline_s
        missed = allowed_s is not None and silence_s > allowed_s
        level, text = _first(
            (ERROR, f"{report.group} is down: {report.down}" if report.down else ""),
            (ERROR, f"silent for {silence_s:.1f} s" if missed and not rate_hz else ""),
            (WARN, f"was silent for {silence_s:.2f} s, {allowed_s:g} s are allowed" if missed else ""),
            default="flows" if rate_hz else "silent" if topic.rate_hz else "on change",
        )
        values = {
            "rate_hz": rate_hz,
            "expected_hz": topic.rate_hz,
            "count": int(count),
            "silence_s": silence_s,
            "deadline_s": allowed_s if allowed_s is not None else "none",
            "counted_by": f"{report.group}, {what}",
        }
        return self._status("topic", topic.name, level, text, values)

    def _status(self, kind: Kind, name: str, level: int, text: str, values: dict[str, Any]) -> dict[str, Any]:
        pairs = [{"key": "kind", "value": kind}, *({"key": k, "value": _figure(v)} for k, v in values.items())]
        where = "topics/" if kind == "topic" else ""
        return {
            "level": level,
            "name": f"{self._vehicle}/{where}{name}",
            "message": text,
            "hardware_id": self._vehicle,
            "values": pairs,
        }


def _first(*causes: tuple[int, str], default: str) -> tuple[int, str]:
    """The first cause that there is."""
    return next(((level, text) for level, text in causes if text), (OK, default))


def _grown(now: dict[str, float], before: dict[str, float], key: str) -> float:
    return now.get(key, 0.0) - before.get(key, now.get(key, 0.0))


def _percent(now_s: float, before_s: float | None, span_s: float) -> float:
    return 100.0 * (now_s - before_s) / span_s if before_s is not None and span_s > 0 else 0.0


def _figure(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
