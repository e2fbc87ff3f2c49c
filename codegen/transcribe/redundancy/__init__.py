"""Equations and values that follow from others: left out, or refused, before a solver meets a singular matrix."""
