"""Planning: local maps and goals in, trajectories out."""
