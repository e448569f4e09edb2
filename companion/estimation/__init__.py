"""LiDAR-inertial-camera odometry (filter), propagation to now, and a fixed-lag factor graph.

`lio` is the front end without messages, `lidar_only` needs no IMU, `graph` the smoother;
`node` holds the three nodes.
"""
