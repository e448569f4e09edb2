"""The aircraft: rigid body, rotors, battery, landing gear, wind, and what its hull touches."""

from sim.vehicle.contact import Obstacles, flat_ground
from sim.vehicle.params import VehicleParams, load_params
from sim.vehicle.vehicle import Vehicle
from sim.vehicle.wind import WindConfig

__all__ = ["Obstacles", "Vehicle", "VehicleParams", "WindConfig", "flat_ground", "load_params"]
