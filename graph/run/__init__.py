"""The factor graph of an odometry run: its factors, the online backends and offline smoothing."""
