"""Worlds to fly in: forests from stand figures or from measured stem maps, and empty ground."""

from sim.world.world import World, load_world

__all__ = ["World", "load_world"]
