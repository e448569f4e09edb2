"""Watches what the sensors deliver: order of stamps, gaps, silence, numbers that are none."""
