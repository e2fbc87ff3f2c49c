"""Nelder and Mead's simplex method, for comparison with the thesis. Source: scipy.optimize, method Nelder-Mead."""

from codegen.drivers.connect import fmin as connect

__all__ = ["connect"]
