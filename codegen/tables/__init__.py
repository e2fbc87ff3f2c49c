"""Tables of numbers: reading their files, fitting splines, and values with derivatives. Nothing here needs sympy."""
