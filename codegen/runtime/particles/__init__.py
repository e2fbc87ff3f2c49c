"""Particles that interact in pairs: motions, connections, passive points."""
