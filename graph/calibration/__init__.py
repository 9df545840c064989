"""Calibration of sensors as variables of a pose graph, in GTSAM's form."""
