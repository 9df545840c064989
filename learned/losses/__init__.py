"""The unsupervised loss and its correspondences."""
