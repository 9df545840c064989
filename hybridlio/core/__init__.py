"""Shared by all rooms: errors, arrays, SE(3), sensors, trajectories, the protocols of the three seams, files."""
