"""What a run leaves behind for smoothing, packed while the run goes on."""
