"""The simulated motion: path, vehicle, traffic, recorded paths."""
