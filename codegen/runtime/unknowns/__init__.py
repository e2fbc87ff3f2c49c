"""The vector of all unknowns: where they stand, the Lagrangian there, what is shared or prescribed."""
