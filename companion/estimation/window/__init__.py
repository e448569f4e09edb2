"""Several sweeps estimated jointly: poses, IMU and planes of the last moments, linearised again and again."""
