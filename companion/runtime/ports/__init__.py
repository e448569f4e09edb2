"""Ports to the outside: the MAVLink link (UDP, TCP, serial) and its signing key."""
