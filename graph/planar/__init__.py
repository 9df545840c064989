"""Planar graphs of relative poses and priors, solved without an object for each factor."""
