"""From a name, a file or a stem map to a `World`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import yaml

from companion.core.errors import InputError
from companion.core.messages import Array
from sim.world import stand
from sim.world.mesh import BRANCH, TRUNK, Mesh, assemble, ground_mesh, leaf_mesh, some_triangles, tube_mesh, wall_mesh
from sim.world.mine import junctions, mine_triangles, tunnels
from sim.world.model import BRANCH_CONE, TRUNK_CONE, Air, Stems, World
from sim.world.reach import sort_cones
from sim.world.spec import (
    EmptySpec,
    MineSpec,
    PoissonSpec,
    StemsSpec,
    TreesSpec,
    WarehouseSpec,
    WorldSpec,
    parse_spec,
)
from sim.world.stems import read_stems
from sim.world.terrain import heights_at, make_heights
from sim.world.walkers import make_walkers
from sim.world.walls import make_walls
from sim.world.warehouse import hall_size, hall_start, warehouse_triangles

__all__ = ["World", "build_world", "load_world", "read_spec"]

WORLDS_DIR = Path(__file__).resolve().parents[2] / "configs" / "worlds"
_STREAMS = ("stems", "terrain", "heights", "lean", "branches", "leaves", "walkers", "walls", "felled")


def load_world(value: str, *, seed: int, options: Mapping[str, object] | None = None) -> World:
    """Build the world that `value` names; same value, seed and options, same bytes.

    `value` is a name in configs/worlds, a path to a YAML file, or `stems:FILE.csv`, each
    followed by `,key=value` options of sim/world/spec.py (`stems:a.csv,unit=cm,plot=3`;
    pairs as `branch_height_m=1/6`); `options` wins over them. Raises InputError.
    """
    spec, name = read_spec(value, options or {})
    return build_world(spec, name=name, seed=seed if spec.seed is None else spec.seed)


def read_spec(value: str, options: Mapping[str, object]) -> tuple[WorldSpec, str]:
    """The checked specification behind `value`, and a short name."""
    head, *pairs = value.split(",")
    inline = dict(_option(pair) for pair in pairs)
    if head.startswith("stems:"):
        path = Path(head.removeprefix("stems:"))
        values: dict[str, object] = {"kind": "stems", "file": str(path)}
        return parse_spec({**values, **inline, **options}), path.stem
    path = Path(head) if head.endswith((".yaml", ".yml")) else WORLDS_DIR / f"{head}.yaml"
    if not path.is_file():
        names = ", ".join(sorted(p.stem for p in WORLDS_DIR.glob("*.yaml")))
        raise InputError(f"no world {head!r}", field="world", valid=f"{names}, FILE.yaml, stems:FILE.csv")
    values = _read_yaml(path)
    if isinstance(file := values.get("file"), str):
        values["file"] = str(path.parent / file)
    return parse_spec({**values, **inline, **options}, file=str(path)), path.stem


def _option(pair: str) -> tuple[str, object]:
    key, equals, text = pair.partition("=")
    if not equals:
        raise InputError(f"{pair!r} is not an option", field="world", valid="key=value")
    parts = [yaml.safe_load(part) for part in text.split("/")]
    numbers = len(parts) == 2 and all(isinstance(p, int | float) for p in parts)
    return key.strip(), parts if numbers else yaml.safe_load(text)


def _read_yaml(path: Path) -> dict[str, object]:
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 0
        raise InputError(f"not YAML: {error.problem}", file=str(path), line=line) from None
    if not isinstance(values, dict):
        raise InputError("a world is a mapping of keys to values", file=str(path), valid="kind: poisson ...")
    return values


def build_world(spec: WorldSpec, *, name: str, seed: int) -> World:
    """Grow the stand that `spec` describes."""
    streams = {part: np.random.default_rng([seed, k]) for k, part in enumerate(_STREAMS)}
    xy, dbh_m, height_m, low, high = _stand(spec, streams)
    lines = _tunnels(spec, streams["walls"])
    start = _start(spec, xy, dbh_m, low, high, lines)
    if isinstance(spec, PoissonSpec):
        keep = np.hypot(*(xy - start).T) - dbh_m / 2 >= spec.clearing_m
        xy, dbh_m, height_m = xy[keep], dbh_m[keep], height_m[keep]
    xy, low, high = xy - start, low - start, high - start
    heights, origin = _ground(spec, low, high, streams["terrain"])
    heights.flags.writeable = origin.flags.writeable = False  # one type for the kernels
    z = heights_at(heights, origin, spec.cell_m, xy)
    stems = Stems(xy[:, 0].copy(), xy[:, 1].copy(), z, dbh_m, height_m)
    cones, kinds, leafy, stems = _trees(spec, stems, streams)
    walkers = make_walkers(
        spec,
        np.column_stack([xy, dbh_m / 2]),
        (low, high),
        lambda points: heights_at(heights, origin, spec.cell_m, points),
        streams["walkers"],
    )
    walls = _walls(spec, start, lines, (heights, origin), streams["walls"])
    parts = [ground_mesh(heights, origin, spec.cell_m), *leafy, *([wall_mesh(walls)] if len(walls) else [])]
    return _frozen(
        World(
            name=name,
            seed=seed,
            bounds=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
            stems=stems,
            cones=cones,
            kinds=kinds,
            heights=heights,
            origin_xy=origin,
            cell_m=spec.cell_m,
            mesh=assemble(parts),
            grid=sort_cones(cones),
            walkers=walkers,
            walls=make_walls(walls),
            air=Air(spec.light, spec.dust, spec.lidar_loss),
        )
    )


def _stand(spec: WorldSpec, streams: Mapping[str, np.random.Generator]) -> tuple[Array, Array, Array, Array, Array]:
    """Stems (N, 2), diameters, heights, and the stand's corners, in the map's own coordinates."""
    if isinstance(spec, StemsSpec):
        measured = read_stems(spec)
        drawn = stand.heights_of(spec, measured.dbh_m, streams["heights"])
        height = np.where(np.isnan(measured.height_m), drawn, np.maximum(measured.height_m, 2.0))
        low, high = measured.xy_m.min(axis=0), measured.xy_m.max(axis=0)
        return measured.xy_m, measured.dbh_m, height, low, high
    low, high = np.zeros(2), hall_size(spec) if isinstance(spec, WarehouseSpec) else np.full(2, spec.size_m)
    if not isinstance(spec, PoissonSpec):
        return np.empty((0, 2)), np.empty(0), np.empty(0), low, high
    xy = stand.scatter(spec, streams["stems"])
    dbh = stand.draw_diameters(spec, len(xy), streams["stems"])
    return xy, dbh, stand.heights_of(spec, dbh, streams["heights"]), low, high


def _start(spec: WorldSpec, xy: Array, dbh_m: Array, low: Array, high: Array, lines: list[Array]) -> Array:
    """Where the flight starts; a measured map must have room there."""
    start = np.array(spec.start_m) if spec.start_m else _own_start(spec, xy, dbh_m, low, high, lines)
    if np.any(start < low) or np.any(start > high):
        valid = f"x {low[0]:.1f} to {high[0]:.1f}, y {low[1]:.1f} to {high[1]:.1f}"
        raise InputError("lies outside the stand", field="start_m", valid=valid)
    room = stand.free_radius(xy, dbh_m, start)
    if isinstance(spec, StemsSpec) and room < spec.clearing_m:
        valid = f"at most {room:.2f} at the start {start[0]:.2f}, {start[1]:.2f}"
        raise InputError(f"no room of {spec.clearing_m:g} m without felling a tree", field="clearing_m", valid=valid)
    return start


def _own_start(spec: WorldSpec, xy: Array, dbh_m: Array, low: Array, high: Array, lines: list[Array]) -> Array:
    """The most open place near the middle, the hall's cross aisle, or the junction nearest to the middle."""
    if isinstance(spec, WarehouseSpec):
        return hall_start(spec)
    if isinstance(spec, MineSpec):
        ends = np.array([line[k] for line in lines for k in (0, -1)])
        return np.asarray(ends[np.argmin(np.linalg.norm(ends - (low + high) / 2, axis=1))])
    return stand.open_place(xy, dbh_m, low, high)


def _tunnels(spec: WorldSpec, rng: np.random.Generator) -> list[Array]:
    return tunnels(junctions(spec, rng), spec, rng) if isinstance(spec, MineSpec) else []


def _walls(
    spec: WorldSpec, start: Array, lines: list[Array], ground: tuple[Array, Array], rng: np.random.Generator
) -> Array:
    """Triangles (T, 3, 3) of what neither grows nor lies on the ground, world frame."""
    if isinstance(spec, MineSpec):
        return mine_triangles(spec, [line - start for line in lines], ground, rng)
    if isinstance(spec, WarehouseSpec):
        return np.asarray(warehouse_triangles(spec, rng) - [*start, 0.0])
    return np.zeros((0, 3, 3))


def _ground(spec: EmptySpec, low: Array, high: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Heights of stand and margin, zero at the start, and their corner; the start is a grid node."""
    first = np.floor((low - spec.margin_m) / spec.cell_m).astype(int)
    last = np.ceil((high + spec.margin_m) / spec.cell_m).astype(int)
    origin = first * spec.cell_m
    shape = (int(last[0] - first[0]) + 1, int(last[1] - first[1]) + 1)
    heights = make_heights(spec, origin, shape, rng)
    return heights - heights[-first[0], -first[1]], origin


def _trees(
    spec: WorldSpec, stems: Stems, streams: Mapping[str, np.random.Generator]
) -> tuple[Array, np.ndarray, list[Mesh], Stems]:
    """Cones with their kinds, the triangles of trunks, branches and leaves, and the stems that are not felled."""
    if not isinstance(spec, TreesSpec):
        return np.empty((0, 9)), np.empty(0, np.int8), [], stems
    trunks = stand.trunk_cones(stems, spec.lean_deg, streams["lean"])
    stands = stand.standing(spec, len(stems), streams["felled"])
    branches = stand.branch_cones(spec, trunks, streams["branches"])
    branches = branches[stands[stand.tree_of_branch(spec, trunks)] & _clear_of_start(branches, spec.clearing_m)]
    meshes = [tube_mesh(trunks[stands], TRUNK), tube_mesh(branches, BRANCH)]
    if spec.crown:
        centers = stand.leaf_centers(spec, trunks, streams["leaves"])
        leaves = leaf_mesh(centers, spec.leaf_m, streams["leaves"])
        meshes.append(some_triangles(leaves, stands[stand.tree_of_leaf(spec, trunks)]))
    kinds = np.repeat(np.array([TRUNK_CONE, BRANCH_CONE], np.int8), [int(stands.sum()), len(branches)])
    return np.concatenate([trunks[stands], branches]), kinds, meshes, _some_stems(stems, stands)


def _some_stems(stems: Stems, keep: np.ndarray) -> Stems:
    parts = (stems.x, stems.y, stems.z_ground, stems.dbh_m, stems.height_m)
    return Stems(*(part[keep] for part in parts))


def _clear_of_start(branches: Array, radius_m: float) -> np.ndarray:
    """Branches (K,) whose segment stays out of the cylinder over the start."""
    base, way = branches[:, :2], branches[:, 6:7] * branches[:, 3:5]
    along = -np.sum(base * way, axis=1) / np.maximum(np.sum(way * way, axis=1), 1e-12)
    nearest = base + np.clip(along, 0.0, 1.0)[:, None] * way
    return np.asarray(np.hypot(nearest[:, 0], nearest[:, 1]) >= radius_m)


def _frozen(world: World) -> World:
    for holder in (world, world.stems, world.mesh, world.grid, world.walkers, world.walls):
        for value in vars(holder).values():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
    return world
