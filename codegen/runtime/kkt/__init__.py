"""The KKT matrix: assembly of elements, factorisation, substitution.

`system` factors and solves. The numbers of unknowns are a `shape`. They are constants in a system that is compiled for
one shape, and are read at run time in a system for any shape (both in `specialised`). The index tables in `shape` hold
the sparsity of a problem. `stages` eliminates the stages of an interval. `elimination` condenses other unknowns inside
an interval, assembles and eliminates the elements of one body, and substitutes. `symmetric` chooses pivots and counts
negative eigenvalues. Linking variables are eliminated last, from the Schur complement of all other unknowns.
"""
