"""Maps as bytes: our own `.umap`, OctoMap's trees, point clouds, and 2D grids of map_server."""
