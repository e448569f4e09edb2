"""Where type definitions come from: the bundled texts, and texts that a peer or a file brings."""

from __future__ import annotations

import difflib
from functools import cached_property
from pathlib import Path

from companion.core.errors import InputError
from companion.runtime.wire.idl import Field, FieldType, Struct, parse_msg, parse_srv

INTERFACES = Path(__file__).parent / "interfaces"
_RULE = "=" * 80  # between the parts of a ros2msg schema, as MCAP wants it
_DEEPEST, _MOST_FIELDS = 40, 20_000  # a peer's schema may be made to do harm
_HALVES = ("_Request", "_Response", "_Event")


class Library:
    """Definitions by full name; what was not added is read from the bundled texts."""

    def __init__(self) -> None:
        self._structs: dict[str, Struct] = {}

    def add(self, name: str, text: str) -> Struct:
        """Take in the .msg text of `name` (`package/msg/Name`); it wins over a bundled one."""
        self._structs[name] = parse_msg(name, text)
        return self._structs[name]

    def struct(self, name: str) -> Struct:
        """The definition, or InputError with the nearest known names."""
        if name not in self._structs:
            self._load(name)
        return self._structs[name]

    def references(self, name: str) -> tuple[str, ...]:
        """Every type that `name` needs, itself not included, sorted; InputError if it contains itself."""
        found: dict[str, int] = {}
        self._collect(name, found, (name,))
        return tuple(sorted(found))

    def schema(self, name: str) -> str:
        """The ros2msg text of `name` with all that it needs behind it."""
        parts = [self.struct(name).text.rstrip("\n")]
        for needed in self.references(name):
            package, _, short = needed.split("/")
            parts.append(f"{_RULE}\nMSG: {package}/{short}\n" + self.struct(needed).text.rstrip("\n"))
        return "\n".join(parts) + "\n"

    def _collect(self, name: str, found: dict[str, int], path: tuple[str, ...]) -> int:
        """Add what `name` needs to `found`, each with its number of primitive fields; returns that of `name`."""
        total = 0
        for field in self.struct(name).fields:
            base = field.type.base
            if field.type.nested:
                if base in path or len(path) > _DEEPEST:
                    problem = "contains itself" if base in path else "is nested too deeply"
                    raise InputError(f"{base} {problem}", field=field.name, file=name)
                if base not in found:
                    found[base] = self._collect(base, found, (*path, base))
            total += found.get(base, 1)
        if total > _MOST_FIELDS:
            raise InputError(f"{total} fields, {_MOST_FIELDS} is the most", file=name)
        return total

    def _load(self, name: str) -> None:
        package, kind, short = _split(name)
        file = INTERFACES / package / kind / f"{short}.{kind}"
        if short.isidentifier() and package.isidentifier() and file.is_file():
            if kind == "msg":
                self._structs[name] = parse_msg(name, file.read_text(), file=str(file))
            else:
                self._add_service(f"{package}/srv/{short}", file.read_text(), str(file))
        if name not in self._structs:
            near = difflib.get_close_matches(name, {**dict.fromkeys(self.bundled), **self._structs}, n=4, cutoff=0.5)
            raise InputError(f"no ROS 2 type {name!r} is known", valid=", ".join(near) or "package/msg/Name")

    def _add_service(self, name: str, text: str, file: str) -> None:
        request, response = parse_srv(name, text, file=file)
        event = (
            Field("info", FieldType("service_msgs/msg/ServiceEventInfo")),
            Field("request", FieldType(request.name, "bounded", 1)),
            Field("response", FieldType(response.name, "bounded", 1)),
        )
        whole = (
            Field("request_message", FieldType(request.name)),
            Field("response_message", FieldType(response.name)),
            Field("event_message", FieldType(f"{name}_Event")),
        )
        for struct in (request, response, Struct(f"{name}_Event", event), Struct(name, whole)):
            self._structs[struct.name] = struct

    @cached_property
    def bundled(self) -> tuple[str, ...]:
        """Full names of all bundled messages and services, sorted."""
        files = (f for f in INTERFACES.glob("*/*/*") if f.suffix in (".msg", ".srv"))
        return tuple(sorted(f"{f.parts[-3]}/{f.parts[-2]}/{f.stem}" for f in files))


def library_of(schema: str, name: str) -> Library:
    """A library from a ros2msg schema (of an MCAP file or a peer), `name` being its first part."""
    library = Library()
    head, *others = schema.split(f"{_RULE}\n")
    library.add(name, head)
    for other in others:
        title, _, text = other.partition("\n")
        if not title.startswith("MSG: ") or title.count("/") not in (1, 2):
            raise InputError(f"{title[:80]!r} heads no part of a schema", file=name, valid="MSG: package/Name")
        parts = title.removeprefix("MSG: ").strip().split("/")
        library.add(f"{parts[0]}/msg/{parts[-1]}", text)
    return library


def _split(name: str) -> tuple[str, str, str]:
    parts = name.split("/")
    if len(parts) != 3 or parts[1] not in ("msg", "srv"):
        raise InputError(f"{name!r} is no ROS 2 type name", valid="package/msg/Name, package/srv/Name")
    package, kind, short = parts
    if kind == "srv":
        for half in _HALVES:
            short = short.removesuffix(half)
    return package, kind, short
