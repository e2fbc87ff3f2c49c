"""Numerical code without symbolic mathematics, which generated modules import.

It needs numpy, numba and the standard library only. `search` solves optimal control problems, and `kkt` solves the
linear systems of the search. `stepping` computes motions, `particles` connects and moves particles. `arithmetic`,
`special` and `tabulated` have functions that kernels call. Compiled functions call the kernels and loops of a problem
by address (`addresses`, `kernels`). `identity`, `kept_code` and `linking` control the machine code that numba makes.
`record` describes the contents of a generated module.
"""
