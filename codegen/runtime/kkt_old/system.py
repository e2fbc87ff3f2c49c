"""The linear system of a Newton step: factor the KKT matrix, solve with the factors."""

from codegen.runtime.kkt.unbordered import solve_system
from codegen.runtime.stand_ins.example import SCALED
from codegen.runtime.unknowns.time_grid import NONE


def factor_kkt(grid, unknowns, weight, diagonal, system, gradient=None, step=None):
    """Factor the KKT matrix and return how many more negative eigenvalues it has than there are equations.

    Zero means that the reduced Hessian is positive definite, as at a minimum. A positive number may be too low: the
    elimination stops when there are too many. None means that the matrix is singular, or that a block that is
    condensed is not positive definite. The Hessian by primal unknowns is multiplied by `weight`; then `diagonal` (n,),
    like `unknowns` (n,), is added to the diagonal of the whole matrix. Where it was factored, `step` (n,), if given, is
    Newton's: the solution of KKT matrix . step = -gradient. The right-hand side takes part in the elimination where
    there is room for it, which takes a third of the work of `solve_kkt` away. Everything is in parts of sizes where the
    grid has them, so that pivots do not depend on units.
    """
    factors, equations = system
    right = unknowns if gradient is None else gradient  # anything will do where nobody asks for the solution
    step = NONE if step is None else step
    steps, h, nodes, _, parameters, _, sizes, forces, *_ = grid  # by name it takes four times as long
    if SCALED and sizes.size:
        unknowns = unknowns * sizes
    regular, excess = solve_system(
        True, unknowns, right, sizes, forces, steps, h, nodes, parameters, weight, diagonal, equations, *factors, step
    )
    return excess if regular else None


def is_factored(excess):
    """Whether what `factor_kkt` gave says that the whole matrix was factored, so that there is a solution."""
    return excess is not None and excess <= 0


def solve_kkt(grid, system, gradient, step):
    """Newton step (n,) for another `gradient` (n,): the matrix is the one that `factor_kkt` has factored last."""
    factors, equations = system
    solve_system(
        False, gradient, gradient, grid.sizes, grid.forces, grid.steps, grid.h, grid.nodes, grid.parameters, 1.0,
        gradient, equations, *factors, step,
    )  # fmt: skip
