"""Measured stem maps: CSV files with x, y and diameter, read as they are."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from companion.core.errors import InputError
from companion.core.messages import Array
from sim.world.spec import StemsSpec

_X, _Y = ("x_m", "x"), ("y_m", "y")
_DIAMETER = {"dbh_m": "m", "dbh_cm": "cm", "dbh": ""}
_HEIGHT = ("height_m", "h_m", "height", "h")
_PLOT = ("plot", "plot_id", "id")
_SCALE = {"m": 1.0, "cm": 0.01}


@dataclass(frozen=True)
class StemMap:
    """Stems in the file's own coordinates; a height of NaN was not measured."""

    xy_m: Array  # (N, 2)
    dbh_m: Array  # (N,)
    height_m: Array  # (N,)


def read_stems(spec: StemsSpec) -> StemMap:
    """Load `spec.file`; raises InputError if columns, unit or plot are not clear."""
    rows, names = _rows(spec.file)
    x, y = _column(names, _X, spec.file), _column(names, _Y, spec.file)
    diameter = _column(names, tuple(_DIAMETER), spec.file)
    scale = _scale(spec, diameter)
    height = next((n for n in _HEIGHT if n in names), None)
    chosen = _of_plot(rows, names, spec)
    table = np.array(
        [
            [
                *(_number(row, name, spec.file, line) for name in (x, y, diameter)),
                _number(row, height, spec.file, line, optional=True) if height else math.nan,
            ]
            for line, row in chosen
        ]
    )
    if np.any(table[:, 2] <= 0):
        raise InputError("diameters must be positive", file=spec.file, field=diameter)
    return StemMap(table[:, :2], table[:, 2] * scale, table[:, 3])


def _rows(file: str) -> tuple[list[tuple[int, dict[str, str]]], list[str]]:
    path = Path(file)
    if not path.is_file():
        raise InputError("no such stem map", field="stems", file=file, valid="a CSV file with x, y, dbh")
    with path.open(newline="", encoding="utf-8") as stream:
        reader = csv.DictReader(stream)
        rows = [(reader.line_num, row) for row in reader]
        names = list(reader.fieldnames or ())
    if not rows:
        raise InputError("holds no stems", file=file)
    return rows, names


def _column(names: list[str], candidates: tuple[str, ...], file: str) -> str:
    for name in candidates:
        if name in names:
            return name
    raise InputError(
        f"no such column among {', '.join(names)}",
        file=file,
        field=candidates[0],
        valid=", ".join(candidates),
    )


def _scale(spec: StemsSpec, column: str) -> float:
    stated = _DIAMETER[column]
    if stated and spec.unit and stated != spec.unit:
        raise InputError(f"{spec.unit} contradicts the column {column}", file=spec.file, field="unit", valid=stated)
    unit = stated or spec.unit
    if not unit:
        raise InputError(f"the column {column} does not say its unit", file=spec.file, field="unit", valid="cm, m")
    return _SCALE[unit]


def _of_plot(
    rows: list[tuple[int, dict[str, str]]], names: list[str], spec: StemsSpec
) -> list[tuple[int, dict[str, str]]]:
    """Rows of one plot. `id` names plots only if it repeats; else it names trees."""
    column = next((n for n in _PLOT if n in names), None)
    plots = list(dict.fromkeys(row[column] for _, row in rows)) if column else []
    single = len(plots) <= 1 or (column == "id" and len(plots) == len(rows))
    if column is None or single:
        if spec.plot is not None:
            raise InputError("the file holds a single plot", file=spec.file, field="plot", valid="leave it out")
        return rows
    if str(spec.plot) not in plots:
        problem = "the file holds several" if spec.plot is None else f"no plot {spec.plot}"
        raise InputError(problem, file=spec.file, field="plot", valid=", ".join(plots))
    return [(line, row) for line, row in rows if row[column] == str(spec.plot)]


def _number(row: dict[str, str], name: str, file: str, line: int, *, optional: bool = False) -> float:
    text = (row[name] or "").strip()
    try:
        value = float(text) if text and text.upper() != "NA" else math.nan
    except ValueError:
        value = math.inf
    if math.isfinite(value) or (optional and math.isnan(value)):
        return value
    raise InputError(f"{text!r} is not a number", file=file, line=line, field=name)
