"""ROS 2 interface texts (`.msg`, `.srv`) to definitions.

Grammar: docs.ros.org, "About ROS 2 interfaces". One definition is a struct of fields in
order, with constants beside; nested types carry their full name `package/msg/Name`.
"""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass, field
from typing import Any, Literal

from companion.core.errors import InputError

ArrayKind = Literal["one", "array", "bounded", "sequence"]

INTEGERS: dict[str, tuple[int, int]] = {
    "byte": (0, 2**8 - 1),
    "char": (0, 2**8 - 1),
    **{f"uint{n}": (0, 2**n - 1) for n in (8, 16, 32, 64)},
    **{f"int{n}": (-(2 ** (n - 1)), 2 ** (n - 1) - 1) for n in (8, 16, 32, 64)},
}
PRIMITIVES = ("bool", *INTEGERS, "float32", "float64")

_TYPE = re.compile(
    r"(?P<base>[A-Za-z][\w/]*)(?:<=(?P<text_cap>[0-9]{1,9}))?(?P<array>\[(?P<upto><=)?(?P<cap>[0-9]{0,9})\])?$"
)
_FIELD_NAME = re.compile(r"[a-z](?:_?[a-z0-9])*_?$")  # rosidl's rule, and its own trailing `_`
_CONSTANT_NAME = re.compile(r"[A-Z](?:_?[A-Z0-9])*$")
_CONSTANT = re.compile(r"(?P<type>\S+)\s+(?P<name>\w+)\s*=\s*(?P<value>.*)$")
_FIELD = re.compile(r"(?P<type>\S+)\s+(?P<name>\w+)(?:\s+(?P<default>.*))?$")
_STRING_ENDS = re.compile(r"""("(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*'|[^#"'])*""")


@dataclass(frozen=True, slots=True)
class FieldType:
    """`base` is a primitive, `string` or a full nested name; 0 capacity is none."""

    base: str
    array: ArrayKind = "one"
    capacity: int = 0
    text_capacity: int = 0

    @property
    def nested(self) -> bool:
        """Whether `base` names another struct."""
        return self.base not in PRIMITIVES and self.base != "string"


@dataclass(frozen=True, slots=True)
class Field:
    """One field; `default` is None where the text gives none."""

    name: str
    type: FieldType
    default: Any = None


@dataclass(frozen=True, slots=True)
class Struct:
    """One message, or one half of a service."""

    name: str
    fields: tuple[Field, ...]
    constants: dict[str, Any] = field(default_factory=dict)
    text: str = ""


def parse_msg(name: str, text: str, *, file: str = "", first_line: int = 1) -> Struct:
    """The struct `name` (`package/msg/Name`) of a .msg text; InputError names file and line."""
    fields: list[Field] = []
    constants: dict[str, Any] = {}
    for number, raw in enumerate(text.splitlines(), first_line):
        line = _without_comment(raw)
        if not line:
            continue
        try:
            if constant := _CONSTANT.match(line):
                constants.update(_constant(constant))
            else:
                fields.append(_field(line, package=name.split("/")[0]))
            if len({f.name for f in fields}) < len(fields):
                raise InputError("the field stands there twice", field=fields[-1].name)
        except InputError as error:
            raise InputError(
                error.problem, file=file or name, line=number, field=error.field, valid=error.valid
            ) from None
    return Struct(name, tuple(fields), constants, text)


def parse_srv(name: str, text: str, *, file: str = "") -> tuple[Struct, Struct]:
    """Request and response, `name_Request` and `name_Response`, of a .srv text."""
    lines = text.splitlines()
    cuts = [i for i, line in enumerate(lines) if line.strip() == "---"]
    if len(cuts) != 1:
        raise InputError("a service has one line --- between request and response", file=file or name)
    halves = ((0, lines[: cuts[0]], "Request"), (cuts[0] + 1, lines[cuts[0] + 1 :], "Response"))
    request, response = (
        parse_msg(f"{name}_{half}", "\n".join(part), file=file, first_line=start + 1) for start, part, half in halves
    )
    return request, response


def _without_comment(line: str) -> str:
    match = _STRING_ENDS.match(line)
    rest = line[match.end() :] if match else ""
    if rest and not rest.startswith("#"):  # a lone quote, as in a comment-less apostrophe
        return line.split("#", 1)[0].strip()
    return line[: match.end()].strip() if match else line.strip()


def _constant(match: re.Match[str]) -> dict[str, Any]:
    name, kind = match["name"], match["type"]
    if not _CONSTANT_NAME.match(name):
        raise InputError("no constant name", field=name, valid="UPPER_CASE")
    if kind.split("<=")[0] not in (*PRIMITIVES, "string"):
        raise InputError(f"a constant cannot have type {kind}", field=name, valid=", ".join(PRIMITIVES) + ", string")
    return {name: _literal(kind.split("<=")[0], match["value"], name)}


def _field(line: str, *, package: str) -> Field:
    match = _FIELD.match(line)
    if not match:
        raise InputError(f"{line!r} is neither a field nor a constant", valid="TYPE NAME [DEFAULT], TYPE NAME=VALUE")
    name = match["name"]
    if not _FIELD_NAME.match(name):
        raise InputError("no field name", field=name, valid="lower_case")
    kind = _field_type(match["type"], package, name)
    default = match["default"]
    return Field(name, kind, None if default is None else _default(kind, default, name))


def _field_type(text: str, package: str, name: str) -> FieldType:
    match = _TYPE.match(text)
    if not match:
        raise InputError(f"{text!r} is no type", field=name, valid="TYPE, TYPE[], TYPE[N], TYPE[<=N], string<=N")
    base, text_cap, cap = match["base"], int(match["text_cap"] or 0), int(match["cap"] or 0)
    if match["text_cap"] and base != "string":
        raise InputError(f"only a string is bounded as {text}", field=name)
    if base == "wstring":
        raise InputError("wstring has no single layout on the wire and is not supported", field=name, valid="string")
    array: ArrayKind = "one"
    if match["array"]:
        array = "bounded" if match["upto"] else "array" if match["cap"] else "sequence"
    if array in ("array", "bounded") and cap < 1:
        raise InputError("needs room for one element at least", field=name)
    return FieldType(_full_name(base, package), array, cap, text_cap)


def _full_name(base: str, package: str) -> str:
    if base in PRIMITIVES or base == "string":
        return base
    parts = base.split("/")
    if len(parts) == 1:
        return "std_msgs/msg/Header" if base == "Header" else f"{package}/msg/{base}"
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else base


def _default(kind: FieldType, text: str, name: str) -> Any:
    if kind.nested:
        raise InputError("a nested type takes no default", field=name)
    if kind.array == "one":
        return _literal(kind.base, text, name)
    if not (text.startswith("[") and text.endswith("]")):
        raise InputError(f"{text!r} is no list", field=name, valid="[A, B, ...]")
    inner = text[1:-1].strip()
    values = [_literal(kind.base, part.strip(), name) for part in _split(inner)] if inner else []
    if (kind.array == "array" and len(values) != kind.capacity) or (kind.capacity and len(values) > kind.capacity):
        raise InputError(f"{len(values)} values for room {kind.capacity}", field=name)
    return values


def _split(text: str) -> list[str]:
    return re.findall(r""""(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*'|[^,\s][^,]*""", text)


def _literal(base: str, text: str, name: str) -> Any:
    if base == "string":
        return _unquoted(text)
    if base == "bool":
        choices = {"true": True, "1": True, "false": False, "0": False}
        if text.lower() not in choices:
            raise InputError(f"{text!r} is no bool", field=name, valid="true, false")
        return choices[text.lower()]
    try:
        value = float(text) if base.startswith("float") else int(text, 0)
    except ValueError:
        raise InputError(f"{text!r} is no {base}", field=name) from None
    if base in INTEGERS and not INTEGERS[base][0] <= value <= INTEGERS[base][1]:
        raise InputError(f"{text} does not fit into {base}", field=name)
    return value


def _unquoted(text: str) -> str:
    if len(text) >= 2 and text[0] == text[-1] and text[0] in "\"'":
        try:
            return str(ast.literal_eval(text))
        except (ValueError, SyntaxError):
            return text[1:-1]
    return text
