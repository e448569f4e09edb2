"""Recognising a place: where was the vehicle, when all it has is what stands around it."""
