"""Tracking: trajectories in, setpoints out."""
