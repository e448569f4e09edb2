"""The bus: Zenoh sessions that ROS 2 machines with rmw_zenoh take for ROS 2 nodes."""
