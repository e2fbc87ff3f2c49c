"""Ordinary numerics that need no symbol, included verbatim in the generated modules that need them.

Every file here is plain, tested Python. Its functions refer to the kernels and sizes of a generated module by name;
so that they can be imported and tested by themselves, each file imports those names from `example.py`, a hand-written
stand-in. `emit.py` drops the import lines, and the generated module's own definitions take their place.
"""
