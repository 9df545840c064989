"""Whole recordings: run one, write its folder, compare, batch, prepare training data."""
