"""The learned implementations of the initial-pose and residual seams."""
