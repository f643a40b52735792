"""Training: photographs -> views -> labels -> batches -> weights."""
