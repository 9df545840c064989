"""A pose graph as plain data: keys, coordinates, measurements, edges, and checks of its structure."""
