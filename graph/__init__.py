"""The factor graph: GTSAM lives here and nowhere else."""
