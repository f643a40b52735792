"""Training of the learned descriptor on pairs of synthetic views of photographs."""
