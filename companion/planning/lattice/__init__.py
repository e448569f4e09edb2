"""Graph search on grids of cells: Dijkstra, A*, Theta*. Lengths are in cells."""
