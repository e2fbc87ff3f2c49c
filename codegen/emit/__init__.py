"""Generation of a module's text from a discretised problem: derivatives, kernels, templates, and verification."""
