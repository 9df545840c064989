"""The simulated sensors: lidar, IMU, GPS."""
