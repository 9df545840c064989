"""Readers of KITTI's raw drives and odometry sequences, and corrections of their data."""
