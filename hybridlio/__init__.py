"""Lidar-inertial odometry that joins a learned front end with a factor graph."""

__version__ = "0.1.0"
