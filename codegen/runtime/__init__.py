"""Numerics without symbols, which generated modules import: numpy, numba and the standard library only.

`search` solves problems of optimal control, `kkt` their linear systems, `stepping` computes motions, `particles`
connects and moves particles. `arithmetic`, `special` and `tabulated` are functions of kernels. Compiled functions call
the kernels and loops of a problem by address (`addresses`, `kernels`). `identity`, `kept_code` and `linking` control
the machine code that numba makes. `record` describes the contents of a generated module.
"""
