"""The KKT matrix: elements of intervals, their factorisation, substitution with its factors.

`system` is what solvers call: factor, then solve. It is `apart` where no unknown is shared by intervals, else
`bordered`; both have `frontal` eliminate the elements of one body, from `elements` with its ends (`ends_flat`,
`ends_curved`) and with what stays inside an interval kept or eliminated beforehand (`element_kept`,
`element_condensed`, `element_barrier`, by `condensation` and `inverse`). `symmetric` chooses pivots, `substitution`
solves.
"""
