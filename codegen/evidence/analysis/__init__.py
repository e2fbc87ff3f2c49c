"""Analyses: the optimum of a problem by the maximum principle, and the modified equations of a scheme on a problem."""
