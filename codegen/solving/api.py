"""The function `codegen.solve`."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ParamSpec

from codegen.errors import ArgumentError
from codegen.solving.request import Request, require_options

if TYPE_CHECKING:
    from codegen.solving.results.result import Result

Arguments = ParamSpec("Arguments")


def _with_signature_of(
    request: Callable[Arguments, Request],
) -> Callable[[Callable[..., Result]], Callable[Arguments, Result]]:
    """Give a function the parameters of a request, whose list then has one place."""

    def decorated(function: Callable[..., Result]) -> Callable[Arguments, Result]:
        signature = inspect.signature(request).replace(return_annotation="Result")
        setattr(function, "__signature__", signature)  # noqa: B010  functions are not declared to have one
        return function

    return decorated


@_with_signature_of(Request)
def solve(*positional: Any, **options: Any) -> Result:  # noqa: D417  they are those of Request
    """Solve a problem; derive and compile its module first where necessary.

    Parameters
    ----------
    problem : path, Control, Simulate, Phases, Connect, Solver or module
        A problem file, an object, a compiled problem, or a generated module (its path, or from `codegen.load`).
    driver : {"newton", "slsqp", "trust-constr", "ipopt", "fsolve", "fmin"}
        "newton" is the generated solver.
    arguments : dict
        Arguments of problem() in a problem file, by name.
    scheme, method, controls, out : str
        Choices of the build, see `codegen.build`.
    steps : int
        Number N of intervals, in each phase; by default that of the problem.
    every : int
        A simulation stores every so many steps.
    repeat : int
        Number of runs; the fastest is timed, without the time of machine code.
    warm : array, shape (n,), or path
        Warm start of an optimisation: `unknowns` of a result on any grid, or a file of `--save`.
    doublings : int
        Number of further solves, on 2 N, 4 N, ... intervals, each from the solution before.
    accuracy : float
        Relative error of states and cost; grids are refined until the estimate is below it. Without `scheme` the
        scheme is gauss-4, or that of the problem if it has path inequalities.
    guesses : int
        Number of initial guesses: that of the problem, then variations. The best solution is returned.
    sensitivities : bool
        Compute `result.sensitivities()`; a separate module is built.
    points : path or PointSet
        Starts and targets (n, d) and standard deviations (n,) of particles; by default the file of the problem.
    parameters : dict
        Parameter overrides without a new build, also of durations and prescribed ends, as in
        {"m": 2.0, "duration": 3.0, "start.x": 1.0}. `Solver.parameters` lists the names.
    tables : dict
        Other files for tables by name, with the same columns and as many breakpoints.
    observations : path, or dict of arrays of shape (n,)
        Other measurements; for several bodies a list with an entry for each.
    tolerance : float
        Tolerance of equations relative to their scale; for particles of the arrival, or of adaptive steps.
    max_iterations, time_limit : int, float
        Limits of one search, and in seconds of all guesses and grids of one run.
    scaling : {"auto", "none"}
        Scaling factors of newton; "none" keeps the units of the problem.
    log, watch : bool, callable
        Refuse drivers without a log; function of the number and the row of the log of each iterate.

    Returns
    -------
    Result
        `status` is "solved" only if all equations hold when they are evaluated outside the driver. A numerical failure
        gives another status and a `message`, not an exception.

    Raises
    ------
    CodegenError
        ArgumentError for an option that does not exist or apply, NumericsError for an unusable number, and other kinds
        for a problem that cannot be read, derived or stored.

    Notes
    -----
    Threads may solve at once. Sources: Marsden and West (2001), Discrete mechanics and variational integrators, for the
    equations; Waechter and Biegler (2006) for the optimiser; Betts (2010), section 4.7, for the refinement of grids.
    """
    require_options(options)
    from codegen.solving.outcome import outcome_of

    try:
        request = Request(*positional, **options)
    except TypeError as error:  # a missing, surplus or repeated argument
        text = str(error).replace("Request.__init__()", "codegen.solve")
        raise ArgumentError(text, "give a problem, a driver if it is not newton, and options by name") from None
    return outcome_of(request).result
