"""How good a trajectory is: metrics, plots and the report."""
