"""Thin layers over GTSAM: noise models, robust weights, iSAM2, preintegration, marginal covariances."""
