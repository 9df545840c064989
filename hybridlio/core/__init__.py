"""The vocabulary of all rooms: errors, arrays, SE(3), sensors, trajectories, protocols of the three seams, files."""
