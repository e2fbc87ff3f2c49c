"""Evidence that what the module finds is a solution."""
