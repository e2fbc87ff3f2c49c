"""Nelder and Mead's simplex method, for comparison. Source: scipy.optimize, method Nelder-Mead."""

from codegen.drivers.connect import fmin as connect

__all__ = ["connect"]
