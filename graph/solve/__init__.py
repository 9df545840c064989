"""Solvers of a pose graph: batch, graduated non-convexity and online, and the initial values they start from."""
