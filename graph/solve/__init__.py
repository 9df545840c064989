"""Solvers of a pose graph: batch, GNC, online, and their starts."""
