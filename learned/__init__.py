"""The learned front end: PyTorch lives here and nowhere else."""
