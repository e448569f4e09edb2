"""Models of the sensors: what they measure, and what spoils it."""
