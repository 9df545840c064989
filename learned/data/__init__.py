"""Training data: shards of prepared scans, and pairs of them."""
