"""The record of a run: everything that smoothing needs, packed during the run."""
