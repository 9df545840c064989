"""The record of a run: everything that smoothing needs, packed while the run goes on."""
