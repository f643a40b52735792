"""The network in torch, its weights, and its export. Needed for training only."""
