"""What `companion topic`, `node`, `service` and `top` do: all of it works without a terminal, and without ROS."""
