"""Runs in other programs: the Rerun viewer, live or afterwards, and MCAP files for Foxglove."""
