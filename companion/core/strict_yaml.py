"""Strict YAML: text -> checked msgspec struct, or one error with file, line, field and valid choices.

    mission = load_strict(text, Mission, file="missions/hop.yaml")

One document, data only: no tags, no anchors, no duplicate keys, no tabs. The types of the struct
say what is valid (`companion.core.strict_types`); numbers are SI numbers, never "3 m".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import msgspec
import yaml

from companion.core.errors import InputError
from companion.core.strict_types import Path, Reader, path_text

T = TypeVar("T")
_CORE_TAGS = frozenset(
    f"tag:yaml.org,2002:{name}"
    for name in ("null", "bool", "int", "float", "str", "seq", "map", "timestamp", "merge", "value")
)
_MAX_CHARACTERS = 1_000_000


def load_strict(text: str, kind: type[T], *, file: str) -> T:
    """Read one YAML document into the struct `kind`; raises InputError."""
    return read_document(text, file=file).to(kind)


@dataclass(frozen=True, slots=True)
class Document:
    """A parsed YAML file that still knows its lines, for checks that types cannot express."""

    root: yaml.Node
    file: str

    def to(self, kind: type[T]) -> T:
        """Convert into `kind`, checking keys, types and ranges; raises InputError."""
        value: T = Reader(self.file).read(self.root, msgspec.inspect.type_info(kind), ())
        return value

    def error(self, path: Path, problem: str, *, valid: str = "") -> InputError:
        """An error at `path`, or at the nearest parent that the file really holds."""
        return InputError(problem, file=self.file, line=self.line_of(path), field=path_text(path), valid=valid)

    def line_of(self, path: Path) -> int:
        """Line (1-based) of the key or item at `path`, or of its nearest existing parent."""
        node, line = self.root, self.root.start_mark.line + 1
        for part in path:
            found = _child(node, part)
            if found is None:
                break
            node, line = found
        return line


def _child(node: yaml.Node, part: str | int) -> tuple[yaml.Node, int] | None:
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            if key.value == part:
                return value, key.start_mark.line + 1
    if isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
        item = node.value[part]
        return item, item.start_mark.line + 1
    return None


def read_document(text: str, *, file: str) -> Document:
    """Parse the syntax alone; raises InputError for anything that is not one plain document."""
    if len(text) > _MAX_CHARACTERS:
        raise InputError(f"{len(text)} characters", file=file, valid=f"at most {_MAX_CHARACTERS}")
    try:
        _refuse_extras(text, file)
        root = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        raise _syntax_error(error, text, file) from None
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise InputError(
            f"character {error.character!r} is not allowed", file=file, line=line, valid="printable text"
        ) from None
    except RecursionError:
        raise InputError("nested too deeply", file=file, line=1, valid="a few levels") from None
    if root is None:
        raise InputError("the file is empty", file=file, line=1, valid="a YAML mapping, key: value")
    return Document(root, file)


def _refuse_extras(text: str, file: str) -> None:
    """No anchors, aliases or tags: they hide what a line means, and aliases can grow without bound."""
    documents = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        line = event.start_mark.line + 1 if event.start_mark else 1
        if anchor := getattr(event, "anchor", None):
            raise InputError(f"anchors and aliases are not allowed: {anchor}", file=file, line=line)
        tag = getattr(event, "tag", None)
        if tag and tag not in _CORE_TAGS:
            raise InputError(f"tags are not allowed: {tag}", file=file, line=line, valid="plain data")
        documents += isinstance(event, yaml.DocumentStartEvent)
        if documents > 1:
            raise InputError("a second document begins here", file=file, line=line, valid="one document")


def _syntax_error(error: yaml.MarkedYAMLError, text: str, file: str) -> InputError:
    mark = error.problem_mark or error.context_mark
    line = mark.line + 1 if mark else 1
    lines = text.splitlines()
    shown = lines[line - 1] if line <= len(lines) else ""
    if "\t" in shown[: len(shown) - len(shown.lstrip())] or "'\\t'" in str(error.problem):
        return InputError("a tab in the indentation", file=file, line=line, valid="spaces")
    what = error.problem or error.context or "cannot be parsed"
    return InputError(f"not valid YAML: {what}", file=file, line=line, valid="key: value, spaces to indent")
