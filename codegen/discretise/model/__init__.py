"""A problem in canonical form: checked, in plain sympy symbols, as tuples in the order of declaration.

`normalise` is the first stage of the pipeline. All later stages rely on these properties. Every symbol is a coordinate,
a velocity (or momentum), a control, a parameter, the number of a body or the time. Names are unique. Every expression
is real, finite and made of functions that can be printed. A Lagrangian is regular. Boundary values, bounds and initial
guesses are finite at the default parameters. The conditions on the motion of one body are independent.
"""
