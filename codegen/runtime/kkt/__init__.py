"""The KKT matrix of a Newton step: assembly from element matrices, factorisation, and substitution.

Linking variables couple the bodies of a problem. Each body is a chain of nodes and intervals.

- `system` is the entry: it factors the KKT matrix of all bodies and solves with the factors. Linking variables are
  eliminated last, from the Schur complement of all other unknowns.
- `shape` holds the numbers of unknowns (a `Shape`) and the index tables of the sparsity of a problem.
- `specialised` compiles the linear system: with the numbers of one Shape as constants, or for all shapes.
- `stages` eliminates the stages of an interval.
- `elimination` condenses other unknowns of an interval, assembles and eliminates the element matrices of one body, and
  substitutes.
- `symmetric` chooses pivots and counts negative eigenvalues.
"""
