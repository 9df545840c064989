"""Measurements made after the run: loop closures and GPS fixes."""
