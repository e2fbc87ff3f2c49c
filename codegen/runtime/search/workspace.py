"""The state of a search: its results, the rows and indices of its work space, and its stages.

`descent` explains the search. The work space has vectors (VECTORS, n) for n unknowns, arrays (BARRIERS, m) for m finite
bounds, REALS floats, and INTEGERS integers.
"""

# Results of `descend`: the reason why it returns.
(
    CONTINUE, SOLVED, SADDLE, NON_FINITE, UNBOUNDED, INFEASIBLE, RANK_DEFICIENT, STALLED, RESTORE, ROOM, GROSS, WEIGHT,
    CURVED,
) = range(13)  # fmt: skip
WORDS = (
    "iteration limit", "solved", "saddle point", "non-finite", "unbounded", "infeasible", "rank-deficient", "stalled",
)  # fmt: skip
"""The termination status for each of the first eight of these numbers."""

# Rows of the vectors (VECTORS, n) and of the arrays (BARRIERS, m) of the work space.
(
    X, G, TRIAL, TRIAL_G, RIGHT, DIAGONAL, STEP, SCALED, SPARE, RIGHT2, STEP2, WATCH_X, LOOSE_X,
) = range(13)  # fmt: skip
VECTORS = 13
(
    DISTANCE, DUALS, MOVED, PUSHED, DUAL_STEP, DUAL_STEP2, WATCH_DISTANCE, WATCH_DUALS, LOOSE_DISTANCE, LOOSE_DUALS,
) = range(10)  # fmt: skip
BARRIERS = 10

# Indices of the state of a search, between calls: floats, then integers. LOOSE_... is the iterate before bounds are
# relaxed less for the first time, and WATCH_... the iterate to which the watchdog may return. KNOWN is the cost of a
# saddle point. LATE, SHORTENED, IN_VAIN, IN_TURN and AT_REST count iterations in turn. DOUBTFUL counts steps whose
# linear system may be solved inaccurately, and ENOUGH is the number of such steps that calls for a measurement. With
# FOLLOWED, the equations depend on the barrier's weight: the search returns WEIGHT after each change of it. SHIFTED
# counts steps in turn with a shifted Hessian near the equations, and SHIFTED_COST is the cost before them.
(
    MU, LEAST_RELAXATION, SHORTEST, SMALL_VIOLATION, FIRST_COST, DELTA_W, LAST_DELTA_W, DAMPING, LENGTH, LAST_ERROR,
    WATCH_VIOLATION, WATCH_OBJECTIVE, WATCH_SLOPE, WATCH_LONGEST, KNOWN, COST, RESIDUAL, VIOLATION,
    STATIONARITY, ERROR, LOOSE_MU, LAST_COST, PUSH, FUNNEL, FIRST_MU, FIRST_VIOLATION, FIRST_ERROR, SHIFTED_COST,
) = range(28)  # fmt: skip
REALS = 28
(
    PAIRS, REFUSED, IN_TURN, EMPTIED, LATE, SHORTENED, WATCHING, IN_VAIN, DOUBTFUL, ENOUGH, LOWERED, WAS_SINGULAR,
    ITERATIONS, IS_WARM, IS_FACTORED, HAS_KNOWN, IS_COSTLESS, HAS_LOOSE, FACTORISATIONS, AT_REST, SEEN, STAGE, ON_PATH,
    LOOKS, IS_BESIDE, FOLLOWED, SHIFTED,
) = range(27)  # fmt: skip
INTEGERS = 27

# The stage of a search. It continues, or it begins with an iterate, with primal unknowns, or with the unknowns of a
# neighbour. A neighbour is the solution of a similar problem; `begin_beside` makes an iterate of its unknowns.
GO_ON, WITH_ITERATE, WITH_UNKNOWNS, WITH_NEIGHBOUR = range(4)
