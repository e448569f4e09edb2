"""Structs -> YAML with a comment per key: what it means, its type, range and unit.

The comments come from the sources: the string under a field, or the comment beside or above it.
"""

from __future__ import annotations

import ast
import functools
import inspect
import re
import textwrap
from collections.abc import Iterator
from typing import Any

import msgspec
import yaml
from msgspec import inspect as mi

from companion.core.strict_types import describe, unit_of

_PLAIN = re.compile(r"[A-Za-z_][\w./ -]*")
_WIDTH = 108


def dump_struct(struct: msgspec.Struct, *, root: str = "") -> str:
    """All fields as YAML that reads back equal; below the key `root`, if given."""
    if not root:
        return "\n".join(_lines(struct, 0)) + "\n"
    return "\n".join([f"{root}:", *_lines(struct, 1)]) + "\n"


@functools.cache
def field_docs(cls: type[Any]) -> dict[str, str]:
    """What the source says of each field of a struct or dataclass; '' where nothing."""
    docs: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if base.__module__ not in ("builtins", "msgspec", "msgspec._core"):
            docs |= _docs_in_source(base)
    return docs


def _lines(struct: msgspec.Struct, depth: int) -> Iterator[str]:
    info = mi.type_info(type(struct))
    assert isinstance(info, mi.StructType)
    docs = field_docs(type(struct))
    for field in info.fields:
        name, value = field.encode_name, getattr(struct, field.name)
        if value is msgspec.UNSET:
            continue
        if isinstance(value, msgspec.Struct):
            doc = docs.get(field.name) or (inspect.getdoc(type(value)) or "").split("\n")[0]
            yield from _comment(doc, depth)
            yield f"{_indent(depth)}{name}:" + ("" if value.__struct_fields__ else " {}")
            yield from _lines(value, depth + 1)
            continue
        kind = describe(field.type, unit_of(name, field.type))
        yield from _comment(f"{docs.get(field.name, '')} [{kind}]".strip(), depth)
        if isinstance(value, dict) and value:
            yield f"{_indent(depth)}{name}:"
            yield from (f"{_indent(depth + 1)}{_flow(k)}: {_flow(v)}" for k, v in value.items())
        else:
            yield f"{_indent(depth)}{name}: {_flow(value)}"


def _indent(depth: int) -> str:
    return "  " * depth


def _comment(text: str, depth: int) -> Iterator[str]:
    head = f"{_indent(depth)}# "
    for line in textwrap.wrap(text, _WIDTH - len(head), break_long_words=False):
        yield head + line


def _flow(value: Any) -> str:
    """A value on one line; numbers so that every YAML reader takes them for numbers."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        text = repr(value)
        return text.replace("e", ".0e") if "e" in text and "." not in text else text
    if isinstance(value, int):
        return str(value)
    if isinstance(value, str):
        plain = _PLAIN.fullmatch(value) and yaml.safe_load(value) == value and value == value.strip()
        return value if plain else yaml.safe_dump(value, default_style='"', width=10**9).rstrip("\n")
    if isinstance(value, msgspec.Struct):
        value = {name: getattr(value, name) for name in value.__struct_fields__}
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_flow(k)}: {_flow(v)}" for k, v in value.items()) + "}"
    return "[" + ", ".join(_flow(item) for item in value) + "]"


def _docs_in_source(cls: type[Any]) -> dict[str, str]:
    try:
        source = textwrap.dedent(inspect.getsource(cls))
    except (OSError, TypeError):  # no source at hand: values without comments
        return {}
    lines = source.splitlines()
    body = ast.parse(source).body[0]
    assert isinstance(body, ast.ClassDef)
    docs = {}
    for statement, following in zip(body.body, [*body.body[1:], None], strict=True):
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            docs[statement.target.id] = _doc_of(statement, following, lines)
    return docs


def _doc_of(statement: ast.AnnAssign, following: ast.stmt | None, lines: list[str]) -> str:
    if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
        return " ".join(str(following.value.value).split())
    assert statement.end_lineno is not None and statement.end_col_offset is not None
    beside = lines[statement.end_lineno - 1].encode()[statement.end_col_offset :].decode().strip()
    if beside.startswith("#"):
        return _words(beside)
    above = []
    for line in reversed(lines[: statement.lineno - 1]):
        if not line.strip().startswith("#"):
            break
        above.append(_words(line.strip()))
    return " ".join(reversed(above))


def _words(comment: str) -> str:
    words = comment.lstrip("#").strip()
    return "" if words.startswith(("noqa", "type:", "fmt:")) else words
