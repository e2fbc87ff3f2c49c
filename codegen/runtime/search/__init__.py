"""The solution of an optimal control problem: `solution.solve_on` is what modules call.

`solve` measures scaling factors (`scaling`) and calls `cascade.minimise`, which searches for a local minimum from
several starts (`iterates`). `newton` calls the compiled search in `descent`, and leads restorations (`restoration`) in
between. `linear_system` has the linear system of a step. `termination` and `messages` say how a search ended.
`problem`, `structure` and `grid` are what all of these read.
"""
