"""`parse_mission(text, file=...)`: the way from a YAML file to a checked mission."""

from __future__ import annotations

from companion.core.strict_yaml import read_document
from companion.mission.check import check_mission
from companion.mission.schema import Mission


def parse_mission(text: str, file: str) -> Mission:
    """Read and check a mission; raises InputError with file, line, field and the valid choices."""
    document = read_document(text, file=file)
    mission = document.to(Mission)
    check_mission(document, mission)
    return mission


__all__ = ["Mission", "parse_mission"]
