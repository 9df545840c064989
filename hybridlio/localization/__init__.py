"""Localisation in a map that was made before."""
