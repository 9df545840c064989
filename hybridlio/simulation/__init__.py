"""The simulated world: a town, a road, a lidar and an IMU that agree with each other exactly."""
