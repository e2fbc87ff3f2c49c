"""Numerics without symbols, which generated modules import: numpy, numba and the standard library only.

`search` solves problems of optimal control, `kkt` their linear systems, `stepping` follows motions, `particles`
connects and moves particles. Compiled functions call what is special about a problem by address (`addresses`,
`kernels`).
"""
