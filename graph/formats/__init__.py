"""Readers and writers of pose graph files."""
