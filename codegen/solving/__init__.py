"""Accuracy on request: intervals of different lengths, chosen such that the estimated error is small enough."""
