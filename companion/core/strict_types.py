"""YAML nodes -> values of the declared types, with errors that name line, field and valid choices."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import msgspec
import yaml
from msgspec import inspect as mi

from companion.core.errors import InputError

Path = tuple[str | int, ...]
_NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?")
_WHOLE = re.compile(r"[-+]?\d+")
_UNITS = {
    "_m_s2": "m/s2", "_m_s": "m/s", "_rad_s": "rad/s", "_deg_s": "deg/s", "_per_ha": "per ha", "_deg": "deg",
    "_rad": "rad", "_hz": "Hz", "_ns": "ns", "_ms": "ms", "_m2": "m2", "_kg": "kg", "_px": "px", "_wh": "Wh",
    "_fraction": "share, 0..1", "_m": "m", "_s": "s", "_w": "W", "_v": "V", "_n": "N",
}  # fmt: skip


def path_text(path: Path) -> str:
    """('steps', 2, 'at') -> 'steps[2].at'."""
    words = (p if isinstance(p, int) or p.isprintable() else repr(p) for p in path)
    return "".join(f"[{w}]" if isinstance(w, int) else f".{w}" for w in words).removeprefix(".")


def unit_of(name: str, kind: mi.Type) -> str:
    """Unit of a field: from `Meta(extra={"unit": ...})`, else from the ending of its name; "" if none."""
    if isinstance(kind, mi.Metadata) and kind.extra and "unit" in kind.extra:
        return str(kind.extra["unit"])
    return next((unit for ending, unit in _UNITS.items() if name.endswith(ending)), "")


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """', did you mean X?' or ''."""
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f", did you mean {close[0]}?" if close else ""


def describe(kind: mi.Type, unit: str = "") -> str:
    """What a type accepts, in words: 'a number > 0 in m'."""
    kind, unit = _bare(kind), unit_of("", kind) or unit
    if isinstance(kind, mi.FloatType | mi.IntType):
        words = "a whole number" if isinstance(kind, mi.IntType) else "a number"
        return " ".join(part for part in (words, _bounds(kind), f"in {unit}" if unit else "") if part)
    if isinstance(kind, mi.UnionType):
        if all(isinstance(_bare(t), mi.StructType) for t in kind.types):
            tags = ", ".join(str(t.tag) for t in kind.types if isinstance(t, mi.StructType))
            return f"a mapping with {getattr(_bare(kind.types[0]), 'tag_field', 'a tag')}: {tags}"
        return " or ".join(describe(t, unit) for t in kind.types)
    if isinstance(kind, mi.LiteralType):
        return ", ".join(str(v) for v in kind.values)
    if isinstance(kind, mi.TupleType):
        items = [describe(t, unit) for t in kind.item_types]
        alike = len(set(items)) == 1
        return f"a list of {len(items)}{', each ' + items[0] if alike else ': ' + ', '.join(items)}"
    if isinstance(kind, mi.VarTupleType | mi.ListType):
        few = f"at least {kind.min_length} of " if kind.min_length else ""
        return f"a list of {few}{describe(kind.item_type, unit)}"
    if isinstance(kind, mi.StructType):
        return f"a mapping with {', '.join(f.encode_name for f in kind.fields)}"
    if isinstance(kind, mi.StrType):
        return f"text matching {kind.pattern}" if kind.pattern else "text"
    others = {mi.BoolType: "true, false", mi.NoneType: "null", mi.DictType: "a mapping"}
    return others.get(type(kind)) or type(kind).__name__


def _bounds(kind: mi.FloatType | mi.IntType) -> str:
    signs = {">": kind.gt, ">=": kind.ge, "<": kind.lt, "<=": kind.le}
    bounds = [f"{sign} {value:g}" for sign, value in signs.items() if value is not None]
    return " and ".join(bounds)


def _bare(kind: mi.Type) -> mi.Type:
    while isinstance(kind, mi.Metadata):
        kind = kind.type
    return kind


def _is_text(node: yaml.Node) -> bool:
    return isinstance(node, yaml.ScalarNode) and (node.style is not None or node.tag.endswith(":str"))


def _shown(node: yaml.Node) -> str:
    if isinstance(node, yaml.ScalarNode):
        text = node.value if len(node.value) <= 40 else node.value[:37] + "..."
        return repr(text) if node.style is not None or " " in text or not text else text
    return f"a list of {len(node.value)}" if isinstance(node, yaml.SequenceNode) else "a mapping"


@dataclass(frozen=True, slots=True)
class Reader:
    """Reads nodes of one file; `file` may be empty (a value of the command line)."""

    file: str

    def read(self, node: yaml.Node, kind: mi.Type, path: Path, unit: str = "") -> Any:
        """The value of `node` as `kind`; raises InputError."""
        kind, unit = _bare(kind), unit_of("", kind) or unit
        method = _METHODS.get(type(kind))
        if method is None:
            raise TypeError(f"{path_text(path)}: strict YAML does not know {kind}")
        return method(self, node, kind, path, unit)

    def fail(self, node: yaml.Node, path: Path, problem: str, valid: str = "") -> InputError:
        """An error at `node`."""
        line = node.start_mark.line + 1 if self.file else 0
        return InputError(problem, file=self.file, line=line, field=path_text(path), valid=valid)

    def _number(self, node: yaml.Node, kind: mi.FloatType | mi.IntType, path: Path, unit: str) -> float | int:
        valid, shown = describe(kind, unit), _shown(node)
        if not isinstance(node, yaml.ScalarNode):
            raise self.fail(node, path, f"{shown} is not a number", valid)
        if node.style is not None and _NUMBER.fullmatch(node.value):
            raise self.fail(node, path, f"{shown} is text: a number goes without quotes", valid)
        if node.value.lower().lstrip("+-.") in ("nan", "inf"):
            raise self.fail(node, path, f"{shown} is not finite", valid)
        if not _NUMBER.fullmatch(node.value):
            raise self.fail(node, path, f"{shown} is not a number", valid)
        whole = isinstance(kind, mi.IntType)
        if whole and (not _WHOLE.fullmatch(node.value) or len(node.value) > 20):
            raise self.fail(node, path, f"{shown} is not a whole number", valid)
        value = int(node.value) if whole else float(node.value)
        if not math.isfinite(value):
            raise self.fail(node, path, f"{shown} is not finite", valid)
        if not _within(value, kind):
            raise self.fail(node, path, f"{shown} is out of range", valid)
        return value

    def _text(self, node: yaml.Node, kind: mi.StrType, path: Path, unit: str) -> str:
        if not isinstance(node, yaml.ScalarNode):
            raise self.fail(node, path, f"{_shown(node)} is not text", describe(kind))
        if not _is_text(node):
            raise self.fail(node, path, f"{_shown(node)} is not text", "text; put it in quotes if meant so")
        value: str = node.value
        if kind.pattern and not re.search(kind.pattern, value):
            raise self.fail(node, path, f"{_shown(node)} is not allowed", describe(kind))
        if len(value) < (kind.min_length or 0) or len(value) > (kind.max_length or len(value)):
            most = f" and at most {kind.max_length}" if kind.max_length else ""
            raise self.fail(node, path, f"{len(value)} characters", f"at least {kind.min_length or 0}{most} characters")
        return value

    def _bool(self, node: yaml.Node, kind: mi.BoolType, path: Path, unit: str) -> bool:
        if not isinstance(node, yaml.ScalarNode) or node.style or node.value not in ("true", "false"):
            raise self.fail(node, path, f"{_shown(node)} is not true or false", "true, false")
        return bool(node.value == "true")

    def _none(self, node: yaml.Node, kind: mi.NoneType, path: Path, unit: str) -> None:
        if not isinstance(node, yaml.ScalarNode) or not node.tag.endswith(":null"):
            raise self.fail(node, path, f"{_shown(node)} is not null", "null")

    def _choice(self, node: yaml.Node, kind: mi.LiteralType, path: Path, unit: str) -> Any:
        by_text = {str(value): value for value in kind.values}
        if isinstance(node, yaml.ScalarNode) and node.value in by_text:
            return by_text[node.value]
        hint = did_you_mean(str(node.value), by_text)
        raise self.fail(node, path, f"{_shown(node)} is not a choice{hint}", ", ".join(by_text))

    def _items(self, node: yaml.Node, kind: mi.VarTupleType | mi.ListType, path: Path, unit: str) -> Any:
        if not isinstance(node, yaml.SequenceNode):
            raise self.fail(node, path, f"{_shown(node)} is not a list", describe(kind, unit))
        few, many = kind.min_length or 0, kind.max_length
        if len(node.value) < few or (many is not None and len(node.value) > many):
            bound = f"{few} to {many} items" if many is not None else f"at least {few}"
            raise self.fail(node, path, f"{len(node.value)} items", bound)
        items = [self.read(n, kind.item_type, (*path, i), unit) for i, n in enumerate(node.value)]
        return items if isinstance(kind, mi.ListType) else tuple(items)

    def _tuple(self, node: yaml.Node, kind: mi.TupleType, path: Path, unit: str) -> tuple[Any, ...]:
        if not isinstance(node, yaml.SequenceNode) or len(node.value) != len(kind.item_types):
            raise self.fail(node, path, f"got {_shown(node)}", describe(kind, unit))
        pairs = zip(node.value, kind.item_types, strict=True)
        return tuple(self.read(n, k, (*path, i), unit) for i, (n, k) in enumerate(pairs))

    def _dict(self, node: yaml.Node, kind: mi.DictType, path: Path, unit: str) -> dict[Any, Any]:
        entries = self._entries(node, path, describe(kind))
        return {
            self.read(key, kind.key_type, path): self.read(value, kind.value_type, (*path, name), unit)
            for name, (key, value) in entries.items()
        }

    def _union(self, node: yaml.Node, kind: mi.UnionType, path: Path, unit: str) -> Any:
        structs = [t for t in kind.types if isinstance(_bare(t), mi.StructType)]
        if isinstance(node, yaml.MappingNode) and structs:
            return self._tagged(node, structs, path) if len(structs) > 1 else self.read(node, structs[0], path)
        plain = [t for t in kind.types if t not in structs]
        null = isinstance(node, yaml.ScalarNode) and node.tag.endswith(":null")
        if structs and (not plain or (not null and all(isinstance(t, mi.NoneType) for t in plain))):
            raise self.fail(node, path, f"{_shown(node)} is not a mapping", describe(kind))
        last: InputError | None = None
        for option in plain:
            try:
                return self.read(node, option, path, unit)
            except InputError as error:
                last = error if last is None or "out of range" in error.problem else last
        assert last is not None
        raise self.fail(node, path, last.problem, describe(kind, unit))

    def _tagged(self, node: yaml.MappingNode, structs: list[Any], path: Path) -> Any:
        tag_field, by_tag = structs[0].tag_field, {str(s.tag): s for s in structs}
        verbs = ", ".join(by_tag)
        found = self._entries(node, path, verbs).get(tag_field)
        if found is None:
            raise self.fail(node, (*path, tag_field), "is missing", verbs)
        word = str(found[1].value) if isinstance(found[1], yaml.ScalarNode) else _shown(found[1])
        if word not in by_tag:
            hint = did_you_mean(word, by_tag)
            raise self.fail(found[1], (*path, tag_field), f"{word!r} is not a choice{hint}", verbs)
        return self.read(node, by_tag[word], path)

    def _struct(self, node: yaml.Node, kind: mi.StructType, path: Path, unit: str) -> Any:
        fields = {f.encode_name: f for f in kind.fields}
        entries = self._entries(node, path, describe(kind))
        if kind.tag_field:
            entries.pop(kind.tag_field, None)
        values: dict[str, Any] = {}
        for name, (key, value) in entries.items():
            if name not in fields:
                hint = did_you_mean(name, fields)
                raise self.fail(key, (*path, name), f"unknown key{hint}", ", ".join(fields))
            field = fields[name]
            values[field.name] = self.read(value, field.type, (*path, name), unit_of(name, field.type))
        for name, field in fields.items():
            if field.required and field.name not in values:
                raise self.fail(node, (*path, name), "is missing", describe(field.type, unit_of(name, field.type)))
        return self.build(node, kind.cls, values, path)

    def build(self, node: yaml.Node, cls: type[msgspec.Struct], values: dict[str, Any], path: Path) -> Any:
        """Construct the struct; what its own `__post_init__` refuses gets the place added."""
        try:
            return cls(**values)
        except InputError as error:
            own = error.field.rpartition(".")[2]  # a struct does not know where it stands
            where = f"{path_text(path)}.{own}".strip(".")
            line = node.start_mark.line + 1 if self.file else 0
            raise InputError(error.problem, file=self.file, line=line, field=where, valid=error.valid) from None
        except ValueError as error:
            raise self.fail(node, path, str(error)) from None

    def _entries(self, node: yaml.Node, path: Path, valid: str) -> dict[str, tuple[yaml.ScalarNode, yaml.Node]]:
        if not isinstance(node, yaml.MappingNode):
            raise self.fail(node, path, f"{_shown(node)} is not a mapping", valid)
        entries: dict[str, tuple[yaml.ScalarNode, yaml.Node]] = {}
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise self.fail(key, path, f"{_shown(key)} cannot be a key", valid)
            if key.value in entries:
                first = entries[key.value][0].start_mark.line + 1
                raise self.fail(key, (*path, key.value), f"given twice, first in line {first}", "once")
            entries[key.value] = (key, value)
        return entries


def _within(value: float, kind: mi.FloatType | mi.IntType) -> bool:
    return (
        (kind.gt is None or value > kind.gt)
        and (kind.ge is None or value >= kind.ge)
        and (kind.lt is None or value < kind.lt)
        and (kind.le is None or value <= kind.le)
    )


_METHODS: dict[type[mi.Type], Callable[..., Any]] = {
    mi.FloatType: Reader._number,
    mi.IntType: Reader._number,
    mi.StrType: Reader._text,
    mi.BoolType: Reader._bool,
    mi.NoneType: Reader._none,
    mi.LiteralType: Reader._choice,
    mi.ListType: Reader._items,
    mi.VarTupleType: Reader._items,
    mi.TupleType: Reader._tuple,
    mi.DictType: Reader._dict,
    mi.UnionType: Reader._union,
    mi.StructType: Reader._struct,
}
