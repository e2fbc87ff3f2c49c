"""Particles that interact in pairs: their motion, connections of given points, and tracer points."""
