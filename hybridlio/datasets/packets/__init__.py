"""Readers of lidars' raw packets, by the vendors' libraries, which are extras."""
