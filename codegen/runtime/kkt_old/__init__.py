"""The KKT matrix: elements of intervals, their factorisation, substitution with its factors.

`system` is what solvers call: factor, then solve. It is `unbordered` where no unknown is shared by intervals, else
`bordered`: shared unknowns are the separator between bodies, eliminated last from the Schur complement of all others.
Both have `frontal` eliminate the elements of one body, from `elements` with its ends (`ends_linear`, `ends_nonlinear`)
and with controls and slacks of an interval kept (`element_uncondensed`) or statically condensed (`element_condensed`,
`element_barrier`, by `static_condensation`, which recovers them afterwards, and `inverse`). `symmetric` chooses pivots
and counts negative eigenvalues, `substitution` solves, `refinement` improves what it finds.
"""
