"""Commands that make, join and use maps."""
