"""Floor 3: the only sockets, threads, processes, files and clocks."""
