"""`tracking.lookahead_s=0.8`: one value of a nested struct, checked like a line of YAML."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import msgspec
from msgspec import inspect as mi

from companion.core.errors import InputError
from companion.core.strict_types import Path, Reader, describe, did_you_mean, path_text, unit_of
from companion.core.strict_yaml import read_document

S = TypeVar("S", bound=msgspec.Struct)
Tree = dict[str, Any]  # key -> Tree, or the text of a value


def apply_overrides_to(struct: S, overrides: Sequence[str], *, root: str = "") -> S:
    """A copy of `struct` with `path.to.key=value` each applied; the last of equals wins. Errors name keys below `root`.

    Raises InputError with the path, the valid keys and a close match, or the type and range.
    """
    tree: Tree = {}
    for text in overrides:
        _plant(tree, text)
    changed = _changed(struct, tree, (root,) if root else ())
    assert isinstance(changed, type(struct))
    return changed


def _plant(tree: Tree, text: str) -> None:
    key, equals, value = text.partition("=")
    parts = [part.strip() for part in key.split(".")]
    if not equals or not all(parts):
        raise InputError(f"{text!r} is not an override", field="--set", valid="path.to.key=value")
    for part in parts[:-1]:
        below = tree.setdefault(part, {})
        if not isinstance(below, dict):  # a whole value came before: the parts go over it
            raise InputError(f"{part} is set as a whole and in parts", field="--set", valid="one of both")
        tree = below
    if isinstance(tree.get(parts[-1]), dict):
        raise InputError(f"{parts[-1]} is set as a whole and in parts", field="--set", valid="one of both")
    tree[parts[-1]] = value.strip()


def _changed(value: Any, tree: Tree, path: Path) -> Any:
    if isinstance(value, msgspec.Struct):
        return _changed_struct(value, tree, path)
    raise InputError(f"has no parts, it is {value!r}", field=path_text(path), valid=f"{path_text(path)}=VALUE")


def _changed_struct(struct: msgspec.Struct, tree: Tree, path: Path) -> msgspec.Struct:
    info = mi.type_info(type(struct))
    assert isinstance(info, mi.StructType)
    fields = {f.encode_name: f for f in info.fields}
    values = {f.name: getattr(struct, f.name) for f in info.fields}
    for key, below in tree.items():
        here = (*path, key)
        if key not in fields:
            hint = did_you_mean(key, fields)
            raise InputError(f"unknown key{hint}", field=path_text(here), valid=", ".join(fields))
        field = fields[key]
        values[field.name] = _value(values[field.name], below, field.type, unit_of(key, field.type), here)
    return _built(type(struct), values, path)


def _value(old: Any, below: Tree | str, kind: mi.Type, unit: str, path: Path) -> Any:
    if isinstance(below, str):
        return _parsed(below, kind, unit, path)
    if not isinstance(old, dict):
        return _changed(old, below, path)
    assert isinstance(kind, mi.DictType)
    new = dict(old)
    for key, deeper in below.items():
        if key not in old and isinstance(deeper, dict):
            hint = did_you_mean(key, old)
            raise InputError(f"unknown key{hint}", field=path_text((*path, key)), valid=", ".join(old))
        new[key] = _value(old.get(key), deeper, kind.value_type, unit, (*path, key))
    return new


def _parsed(text: str, kind: mi.Type, unit: str, path: Path) -> Any:
    if not text:
        raise InputError("has no value", field=path_text(path), valid=describe(kind, unit))
    try:
        node = read_document(text, file="").root
    except InputError as error:
        raise InputError(f"{text!r}: {error.problem}", field=path_text(path), valid=error.valid) from None
    return Reader("").read(node, kind, path, unit)


def _built(cls: type[msgspec.Struct], values: dict[str, Any], path: Path) -> msgspec.Struct:
    node = read_document("{}", file="").root
    struct = Reader("").build(node, cls, values, path)
    assert isinstance(struct, msgspec.Struct)
    return struct
