"""Pose graphs: files of g2o, and optimisation that survives wrong closures."""
