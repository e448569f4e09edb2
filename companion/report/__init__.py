"""What a flight leaves behind for people: the figures and the picture."""
