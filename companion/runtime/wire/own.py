"""Our own messages to values of `understory_msgs` and back, generated from both definitions.

A field is carried under its own name, so the message class and the .msg text are the whole
mapping. What differs: the stamp becomes `header.stamp`, quaternions wxyz become
geometry_msgs/Quaternion (xyzw), matrices and grids are flat.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from companion.core import messages as m
from companion.runtime.wire.errors import WireError
from companion.runtime.wire.idl import Field
from companion.runtime.wire.parts import header_of, quaternion_of, stamp_of
from companion.runtime.wire.types import WireType

PACKAGE = "understory_msgs"
FRAMES: dict[type[Any], str] = {  # header.frame_id, where there is one
    **dict.fromkeys((m.LioState, m.PoseLikelihood, m.Odometry, m.LocalMap, m.MapDelta, m.Goal), "odom"),
    **dict.fromkeys((m.Trajectory, m.PlanStatus, m.Setpoint, m.VehicleStatus), "odom"),
    m.Landmarks: "odom",
    m.ObstacleTracks: "odom",
    m.PoseCorrections: "odom",
    m.MapFromOdom: "map",
    m.RegisteredScan: "base_link",
    m.SmoothedState: "map",
    m.GroundTruth: "world",
}
_MATRICES = {"covariance": (18, 18), "information": (6, 6)}
_GRIDS = {"state": 3, "distance_m": 3, "unknown_distance_m": 3, "ground_z_odom": 2}  # dimensions, of LocalMap

ToValue = Callable[[Any], dict[str, Any]]
FromValue = Callable[[dict[str, Any]], Any]


def converters(kind: type[Any], wire: WireType, inner: Callable[[str], WireType]) -> tuple[ToValue, FromValue]:
    """Message to value, and value to message (arrays read-only); `inner` finds nested types."""
    source = _Source(kind, inner)
    for field in wire.fields:
        source.add(field)
    return source.compile()


class _Source:
    """Both directions of one message class as Python expressions per field."""

    def __init__(self, kind: type[Any], inner: Callable[[str], WireType]) -> None:
        self._kind, self._inner = kind, inner
        self._hints = typing.get_type_hints(kind)
        self._there: list[str] = []
        self._back: list[str] = []
        self._names: dict[str, Any] = {
            "Message": kind,
            "freeze": m.freeze,
            "array": np.array,
            "choose": _choose,
            "contiguous": np.ascontiguousarray,
        }

    def add(self, field: Field) -> None:
        """One field of the .msg text."""
        name, base = field.name, field.type.base
        there, back = f"m.{name}", f"v[{name!r}]"
        if base == "std_msgs/msg/Header":
            self._header()
            return
        if name == "shape" and self._kind is m.LocalMap:
            self._there.append("'shape': array(m.state.shape, 'u4')")
            return
        if base == "geometry_msgs/msg/Quaternion":
            self._there.append(f"{name!r}: quaternion({there})")
            self._names.update(quaternion=quaternion_of)
            self._back.append(f"{name}=array(({back}['w'], {back}['x'], {back}['y'], {back}['z']))")
            return
        if base.startswith(f"{PACKAGE}/"):
            to_value, from_value = converters(self._hints[name], self._inner(base), self._inner)
            self._names.update({f"to_{name}": to_value, f"from_{name}": from_value})
            there, back = f"to_{name}({there})", f"from_{name}({back})"
        elif base in ("geometry_msgs/msg/Point", "geometry_msgs/msg/Point32"):
            back = f"{back}.view('{'f4' if base.endswith('32') else 'f8'}').reshape(-1, 3)"
        elif self._hints[name] is bytes:
            back = f"{back}.tobytes()"
        elif name == "q_odom_body":  # several; a single one is a Quaternion
            back = f"{back}.reshape(-1, 4)"
        elif name in _MATRICES:
            back = f"{back}.reshape{_MATRICES[name]}"
        elif self._kind is m.LocalMap and name in _GRIDS:
            there, back = f"contiguous({there})", f"{back}.reshape(v['shape'][:{_GRIDS[name]}])"
        elif typing.get_origin(self._hints[name]) is Literal:
            self._names[f"choices_{name}"] = typing.get_args(self._hints[name])
            back = f"choose({name!r}, {back}, choices_{name})"
        self._there.append(f"{name!r}: {there}")
        self._back.append(f"{name}={back}")

    def _header(self) -> None:
        frame = FRAMES.get(self._kind, "")
        self._there.append(f"'header': header(m.stamp_ns, {frame!r})")
        self._names.update(header=header_of, stamp=stamp_of)
        self._back.append("stamp_ns=stamp(v['header'])")

    def compile(self) -> tuple[ToValue, FromValue]:
        """The two functions."""
        missing = {f.name for f in dataclasses.fields(self._kind)} - {b.split("=")[0] for b in self._back}
        assert not missing, f"{PACKAGE}/msg/{self._kind.__name__}.msg lacks {sorted(missing)}"
        exec(
            f"def to_value(m): return {{{', '.join(self._there)}}}\n"
            f"def from_value(v): return freeze(Message({', '.join(self._back)}))",
            self._names,
        )
        return self._names["to_value"], self._names["from_value"]


def _choose(field: str, value: str, choices: tuple[str, ...]) -> str:
    if value not in choices:
        raise WireError(f"{field}: {value[:60]!r} (valid: {', '.join(choices)})")
    return value
