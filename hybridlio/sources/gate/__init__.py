"""Scans and IMU compared at each step: which of them is believed, how far, and what stays in doubt."""
