"""The simulated surroundings: roads, ground, objects beside the road, and ray casting."""
