"""Hand-written kernels, with which the numerics are tested without a generated module."""
