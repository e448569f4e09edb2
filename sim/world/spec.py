"""What a world is made of: one strict struct per kind, read from YAML or from `key=value` options.

Leaves exist only above `crown_base_m`; a tree that is not higher carries none. Trunks and
branches are obstacles for the hull and for the sensors, leaves for the sensors alone; racks,
halls and rock are obstacles for both.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Literal, get_args, get_type_hints

import msgspec

from companion.core.errors import InputError

Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Count = Annotated[int, msgspec.Meta(ge=0)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
Span = tuple[NotNegative, NotNegative]


class EmptySpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="kind", tag="empty"):
    """Ground without trees; also the ground of the other kinds."""

    seed: Annotated[int, msgspec.Meta(ge=0)] | None = None  # fixes the layout; None: the flight's own seed
    size_m: Annotated[float, msgspec.Meta(ge=10, le=500)] = 120.0  # side of the square stand
    margin_m: Annotated[float, msgspec.Meta(ge=2, le=200)] = 20.0  # bare ground around the stand
    cell_m: Annotated[float, msgspec.Meta(ge=0.1, le=5)] = 0.5  # of the height field
    slope_deg: Annotated[float, msgspec.Meta(ge=0, le=45)] = 0.0
    slope_heading_deg: float = 0.0  # uphill, from +x towards +y
    roughness_m: Annotated[float, msgspec.Meta(ge=0, le=5)] = 0.1  # rms of the bumps
    roughness_length_m: Positive = 6.0  # size of the bumps
    start_m: tuple[float, float] | None = None  # in the map's coordinates; None: most open near the centre
    clearing_m: NotNegative = 2.0  # free radius around the start
    walkers: Annotated[int, msgspec.Meta(ge=0, le=100)] = 0  # upright cylinders on drawn ways, to and fro
    walker_paths: tuple[Annotated[tuple[tuple[float, float], ...], msgspec.Meta(min_length=2)], ...] = ()
    """Corners, m from the start, of the ways of further walkers."""
    walker_speed_m_s: tuple[Positive, Positive] = (0.5, 2.0)  # drawn once for each
    walker_radius_m: Positive = 0.3
    walker_height_m: Positive = 1.8
    walker_reach_m: Annotated[float, msgspec.Meta(ge=6, le=250)] = 20.0  # drawn ways lie so near to the start in x, y
    walker_turns: Annotated[int, msgspec.Meta(ge=0, le=10)] = 1  # corners of a drawn way between its ends
    walker_start_gap_m: NotNegative = 3.0  # how far they keep off the start
    light: Share = 1.0  # what the camera gets of daylight
    dust: Share = 0.0  # share of the LiDAR's beams that dust 0.5 to 3 m away returns
    lidar_loss: Share = 0.0  # share of its returns that are lost besides the sensor's own


class TreesSpec(EmptySpec, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What stands on stems wherever they come from."""

    height_max_m: Annotated[float, msgspec.Meta(ge=3, le=100)] = 29.0  # of the dbh-height curve
    height_rate_per_m: Positive = 3.0  # h = 1.3 + (height_max - 1.3) (1 - exp(-rate dbh)), Meyer 1940
    height_sd: Annotated[float, msgspec.Meta(ge=0, le=0.3)] = 0.08  # relative spread around the curve
    lean_deg: Annotated[float, msgspec.Meta(ge=0, le=30)] = 1.5  # sigma per axis
    felled: Share = 0.0  # of the trees, gone since: those that are left stand as they do without it
    crown: bool = True  # leaves, or a bare stand
    crown_base_m: Positive = 8.0  # no leaf below, above ground
    crown_radius_m: Positive = 1.8
    leaves: Count = 100  # triangles per tree
    leaf_m: Positive = 0.35  # size of one triangle (a cluster of leaves)
    branches: Count = 0  # thin, leafless, per tree
    branch_length_m: Span = (0.5, 1.5)
    branch_diameter_m: Span = (0.01, 0.04)  # at the trunk
    branch_height_m: Span = (0.5, 8.0)  # above ground


class PoissonSpec(TreesSpec, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="poisson"):
    """Random stems; a hard core keeps them apart."""

    stems_per_ha: Annotated[float, msgspec.Meta(ge=0, le=10000)] = 400.0
    min_spacing_m: NotNegative = 1.5  # between stem centres
    dbh_mean_m: Positive = 0.25  # log-normal
    dbh_sd_m: NotNegative = 0.08


class StemsSpec(TreesSpec, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="stems"):
    """A measured stem map; none of its trees is ever removed."""

    file: str
    unit: Literal["cm", "m"] | None = None  # of the diameters, if the header does not say it
    plot: int | str | None = None  # which one, if the file holds several


class WarehouseSpec(EmptySpec, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="warehouse"):
    """Racks in a hall; its size follows from them."""

    roughness_m: Annotated[float, msgspec.Meta(ge=0, le=5)] = 0.003
    margin_m: Annotated[float, msgspec.Meta(ge=2, le=200)] = 2.0
    rack_rows: Annotated[int, msgspec.Meta(ge=1, le=40)] = 5
    bays: Annotated[int, msgspec.Meta(ge=1, le=60)] = 12  # along a rack
    bay_m: Annotated[float, msgspec.Meta(ge=1, le=6)] = 2.8
    levels: Annotated[int, msgspec.Meta(ge=1, le=8)] = 3
    level_m: Annotated[float, msgspec.Meta(ge=0.8, le=4)] = 1.9  # height of one
    rack_depth_m: Annotated[float, msgspec.Meta(ge=0.4, le=4)] = 1.2
    aisle_m: Annotated[float, msgspec.Meta(ge=1.5, le=10)] = 3.2  # width
    cross_aisle_m: Annotated[float, msgspec.Meta(ge=2, le=20)] = 5.0  # at both ends of the racks
    height_m: Annotated[float, msgspec.Meta(ge=2.5, le=30)] = 8.0  # of the hall
    load_share: Share = 0.8  # of the places on the shelves that are taken


class MineSpec(EmptySpec, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="mine"):
    """Tunnels in rock; `size_m` is the side of the square in which junctions lie."""

    size_m: Annotated[float, msgspec.Meta(ge=10, le=500)] = 100.0
    roughness_m: Annotated[float, msgspec.Meta(ge=0, le=5)] = 0.08
    roughness_length_m: Positive = 3.0
    spacing_m: Annotated[float, msgspec.Meta(ge=8, le=100)] = 25.0  # of the junctions
    jitter_m: Annotated[float, msgspec.Meta(ge=0, le=20)] = 4.0
    bend_m: Annotated[float, msgspec.Meta(ge=0, le=20)] = 3.0
    loops: Share = 0.4  # of the tunnels that would make a ring, how many are there
    half_width_m: tuple[Positive, Positive] = (1.8, 2.8)  # low and high
    tunnel_height_m: tuple[Positive, Positive] = (3.2, 4.5)
    rock_roughness_m: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.15  # rms of walls and roof
    rock_length_m: Annotated[float, msgspec.Meta(ge=0.3, le=10)] = 1.0  # size of their bumps
    rock_cell_m: Annotated[float, msgspec.Meta(ge=0.2, le=1)] = 0.4  # of their triangles


WorldSpec = EmptySpec | PoissonSpec | StemsSpec | WarehouseSpec | MineSpec
KINDS: dict[str, type[EmptySpec]] = {
    "empty": EmptySpec,
    "poisson": PoissonSpec,
    "stems": StemsSpec,
    "warehouse": WarehouseSpec,
    "mine": MineSpec,
}
_SPANS = (
    "branch_length_m", "branch_diameter_m", "branch_height_m", "walker_speed_m_s", "half_width_m", "tunnel_height_m",
)  # fmt: skip


def parse_spec(values: Mapping[str, object], *, file: str = "") -> WorldSpec:
    """Check a mapping with key `kind`; raises InputError with the field and what is valid."""
    kind = values.get("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        raise InputError(f"unknown kind {kind!r}", file=file, field="kind", valid=", ".join(KINDS))
    try:
        spec: WorldSpec = msgspec.convert(dict(values), WorldSpec)
    except msgspec.ValidationError as error:
        raise _readable(error, KINDS[kind], file) from None
    for name in _SPANS:
        low, high = getattr(spec, name, (0.0, 0.0))
        if low > high:
            raise InputError(f"{low} exceeds {high}", file=file, field=name, valid="low, high")
    return spec


def _readable(error: msgspec.ValidationError, spec: type[EmptySpec], file: str) -> InputError:
    text = str(error)
    names = ", ".join(spec.__struct_fields__)
    unknown = re.search(r"unknown field `(\w+)`", text)
    missing = re.search(r"missing required field `(\w+)`", text)
    if found := unknown or missing:
        problem = "unknown key" if unknown else "is required"
        return InputError(problem, file=file, field=found[1], valid=names)
    problem, _, place = text.partition(" - at `$.")
    field = re.split(r"[`\[.]", place)[0]
    choices = [c for part in get_args(get_type_hints(spec).get(field)) for c in get_args(part)]
    valid = ", ".join(c for c in choices if isinstance(c, str))
    return InputError(problem, file=file, field=field, valid=valid)
