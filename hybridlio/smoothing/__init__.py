"""Measurements made after the run, for smoothing: loop closures and the alignment of GPS fixes."""
