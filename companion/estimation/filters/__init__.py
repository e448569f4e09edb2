"""Filters behind one interface: Kalman, extended, unscented, and a fixed-lag graph beside them."""
