"""Training runs: their recipes, and their data from recordings or the simulator."""
