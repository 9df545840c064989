"""A solved graph for other programs and for the eye: GTSAM, networkx, Graphviz, trajectories, pictures."""
