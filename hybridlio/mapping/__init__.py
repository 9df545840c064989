"""Maps: the scans of a run as one cloud in the world frame, its files, and meshes of it."""
