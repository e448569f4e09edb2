"""Measurements of the running stack's parts, for `companion bench`."""
