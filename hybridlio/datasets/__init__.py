"""Readers, one file each, and the sequence they return."""
