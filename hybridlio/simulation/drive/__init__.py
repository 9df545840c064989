"""The simulated motion: the path, the vehicle, traffic, and recorded paths."""
