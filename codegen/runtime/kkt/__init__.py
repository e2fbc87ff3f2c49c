"""The KKT matrix: elements of intervals, their factorisation, substitution with its factors."""
