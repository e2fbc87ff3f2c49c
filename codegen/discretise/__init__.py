"""From a problem to a program: the canonical model, a scheme, and the function of one interval."""
