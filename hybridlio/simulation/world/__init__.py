"""The simulated surroundings: roads, ground, houses, and the ray-casting scene."""
