"""A pose graph as plain data: keys, coordinates, measurements, edges, checks."""
