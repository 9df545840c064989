"""Thin layers over GTSAM: noise models, iSAM2, preintegration, marginals."""
