"""Functions beyond those that Python has."""
