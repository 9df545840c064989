"""The simulated sensors: lidar, IMU and GPS."""
