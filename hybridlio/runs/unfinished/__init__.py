"""Runs that are not finished: kept on the disk as they go, and resumed."""
