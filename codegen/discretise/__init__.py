"""From a problem to a program: the canonical model, the schemes, and the expressions of one interval."""
