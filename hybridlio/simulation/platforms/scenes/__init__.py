"""The scenes: what stands in them, and the way through them."""
