"""Understory: the autonomy stack of a companion computer, in the order of the data flow.

sensors -> estimation -> mapping -> planning -> tracking -> autopilot -> (MAVLink) -> vehicle
                              mission drives the goals        safety watches all of it

`core` holds the shared words, the stages are packages of pure algorithms and nodes without
I/O, `stack` wires them, and only `runtime` owns sockets, threads, files and clocks.
"""

__version__ = "0.1.0"
