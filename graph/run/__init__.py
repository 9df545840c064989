"""The odometry run's own graph: factors, backends, smoothing."""
