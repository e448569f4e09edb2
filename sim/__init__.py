"""The simulator: world, physics, sensors and a PX4-like autopilot that speaks MAVLink bytes.

It stands in for the aircraft and shares only `companion.core` with the stack that it tests.
"""
