"""The classical implementations of the three seams."""
