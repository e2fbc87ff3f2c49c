"""A pairwise Hamiltonian and its derivatives as loops over particles and pairs: `module` calls the others."""
