"""Numerics without symbols, which generated modules import: searches, linear systems, steps, particles, tables."""
