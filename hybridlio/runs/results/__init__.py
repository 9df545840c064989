"""What commands make of runs: the input of reports and of maps."""
