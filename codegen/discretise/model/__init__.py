"""A problem in canonical form: checked, in plain sympy symbols, as tuples in the order of declaration.

`normalise` is the first stage of the pipeline. Everything after it may rely on: every symbol is a coordinate, a
velocity (or momentum), a control, a parameter, a body's number or the time; names are unique; every expression is
real, finite and made of functions that can be printed; a Lagrangian is regular; boundary values, bounds and first
guesses are finite at the default parameters, and the conditions on one body's motion do not depend on each other.
"""
