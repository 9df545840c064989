"""Starts: the first steps, a search over several scans, and an IMU whose samples start after the scans."""
