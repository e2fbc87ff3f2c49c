"""The KKT matrix: assembly of elements, factorisation, substitution.

`system` is what solvers call: factor, then solve. Its numbers of unknowns are a `shape`, constants in a system that is
compiled for one shape (`specialised`), read at run time in one for any shape (`any_shape`); `tables` hold the sparsity
of a problem. `frontal` assembles and eliminates the elements of one body, `condensation` eliminates unknowns inside
intervals before, and recovers them afterwards. `symmetric` chooses pivots and counts negative eigenvalues,
`substitution` solves. Linking variables are eliminated last, from the Schur complement of all others.
"""
