"""One step of a simulation, solved explicitly as far as possible."""
