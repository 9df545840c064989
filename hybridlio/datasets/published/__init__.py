"""Readers of published data sets, one file each, with the sensors' mounting built in."""
