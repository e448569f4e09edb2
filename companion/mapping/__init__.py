"""Mapping: registered scans become one voxel map, and local distance fields around the vehicle."""
