"""Localisation in a prior map: Monte Carlo, and an extended Kalman filter on the same likelihood field."""
