"""The learned front end, the only part of the package that imports PyTorch."""
