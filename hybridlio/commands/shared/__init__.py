"""What several commands share: names that shells complete, and options of GPS and of training."""
