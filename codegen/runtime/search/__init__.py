"""The solution of optimal control problems; generated modules call `solution.solve_on`.

`solve` chooses scaling factors (`scaling`) and calls `cascade.minimise`, which searches for a local minimum from
several starts (`iterates`). `newton` calls the compiled search in `descent`, with feasibility restorations
(`restoration`) between the calls. `linear_system` stores and solves the linear system of a Newton step. `termination`
and `messages` report how a search has ended. All these modules read `problem`, `structure` and `grid`.
"""
