"""Missions: a YAML file becomes goals, commands and decisions; `model` reads, `executor` flies."""
