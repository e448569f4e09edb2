"""Worlds to fly in: forests from stand figures or from measured stem maps, and empty ground."""

from sim.world.load import load_world
from sim.world.world import World

__all__ = ["World", "load_world"]
