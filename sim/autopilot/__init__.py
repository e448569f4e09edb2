"""A simulated PX4-flavoured autopilot that speaks MAVLink 2 bytes; start at `autopilot.py`."""
