"""Runs over whole recordings: run one, write its folder, compare settings, run batches, prepare training data."""
