"""Comparison of a lidar's motion with the IMU's: offset of the clocks, rotation between the sensors, gross errors."""
