"""Rejection of wrong loops: those that confirm one another, graduated non-convexity, the search over both."""
