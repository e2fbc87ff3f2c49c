"""The linear system of a Newton step: factor the KKT matrix, solve with the factors."""

from codegen.runtime.kkt.unbordered import factor, substitute
from codegen.runtime.stand_ins.example import CARRIED, SCALED


def factor_kkt(grid, unknowns, weight, diagonal, system, gradient=None):
    """Factor the KKT matrix and return how many more negative eigenvalues it has than there are equations.

    Zero means that the reduced Hessian is positive definite, as at a minimum. A positive number may be too low: the
    elimination stops when there are too many. None means that the matrix is singular, or that a block that is
    condensed is not positive definite. The Hessian by primal unknowns is multiplied by `weight`; then `diagonal` (n,),
    like `unknowns` (n,), is added to the diagonal of the whole matrix. The right-hand side -`gradient` (n,) takes part
    in the elimination where there is room for it, which takes a third of the work of `solve_kkt` away. Everything is in
    parts of sizes where the grid has them, so that pivots do not depend on units.
    """
    factors, equations = system
    right = unknowns if gradient is None else gradient  # anything will do where nobody asks for the solution
    if SCALED and grid.sizes.size:
        unknowns = unknowns * grid.sizes
    regular, excess = factor(
        unknowns, right, grid.sizes, grid.forces, grid.steps, grid.h, grid.parameters, weight, diagonal, equations,
        *factors,
    )  # fmt: skip
    return excess if regular else None


def is_factored(excess):
    """Whether what `factor_kkt` gave says that the whole matrix was factored, so that `solve_kkt` may follow."""
    return excess is not None and excess <= 0


def solve_kkt(grid, system, gradient, step, carried=False):
    """Newton step (n,): the solution of KKT matrix . step = -gradient, after `factor_kkt` gave a number.

    That number must not have been positive. `carried` says that `factor_kkt` had the same `gradient` (n,).
    """
    if CARRIED:
        substitute(gradient, carried, grid.steps, *system[0], step)
    else:
        substitute(gradient, False, grid.steps, *system[0], step)
