"""The only package that speaks MAVLink: bytes on one side, the stack's messages on the other.

`wire` finds frames in bytes, `codec` reads and writes their payloads, `frames` turns NED/FRD
into ENU/FLU and back, `timesync` maps clocks, `node` puts them together; `inspect` looks
into recorded logs.
"""
