"""Training, validation, ablation."""
