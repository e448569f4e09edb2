"""Tracks of things that move: points that the map did not expect, clustered and followed by Kalman filters."""
