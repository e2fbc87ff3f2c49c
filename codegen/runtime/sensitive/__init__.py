"""Sensitivities: how a solution follows parameters, boundary values and a given duration."""
