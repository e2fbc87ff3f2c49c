"""The linear system of Newton's method: assembly of elements, frontal factorisation, substitution.

`shape` lists the numbers that a factorisation has as constants, and `specialised` writes and compiles the text of a
shape. `system` is what the search calls. `frontal` eliminates the elements of one body, `condensation` the unknowns of
an interval before, `symmetric` chooses pivots and counts negative eigenvalues, `substitution` solves, and `inverse`
inverts a condensed block. `tables` says where entries of a matrix are, `any_shape` serves interpreted problems.
"""
