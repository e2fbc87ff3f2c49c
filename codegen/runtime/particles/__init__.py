"""Particles that interact in pairs: motions, connections, tracer points."""
