"""Readers of point files, and the meaning of their columns."""
