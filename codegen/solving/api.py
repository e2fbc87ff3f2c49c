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
    """Return a decorator that gives a function the signature of `request`, so that it is written only once."""

    def decorated(function: Callable[..., Result]) -> Callable[Arguments, Result]:
        signature = inspect.signature(request).replace(return_annotation="Result")
        setattr(function, "__signature__", signature)  # noqa: B010  functions are not declared to have one
        return function

    return decorated


@_with_signature_of(Request)
def solve(*positional: Any, **options: Any) -> Result:  # noqa: D417  the arguments are the fields of Request
    """Solve a problem; derive and compile its module first where necessary.

    Parameters
    ----------
    problem : path, Control, Simulate, Phases, Connect, Solver or module
        A problem file, a problem object, a compiled problem from `codegen.compile`, or a generated module. A module is
        given by its path, or loaded by `codegen.load`.
    driver : {"newton", "slsqp", "trust-constr", "ipopt", "fsolve", "fmin"}
        "newton" is the generated solver.
    arguments : dict
        Arguments of problem() in a problem file, by name.
    scheme, method, controls, out : str
        Options of the build, see `codegen.build`.
    steps : int
        Number N of intervals in each phase; by default the number in the problem.
    every : int
        A simulation stores every `every`-th step.
    repeat : int
        Number of runs. The time of the fastest run is reported, without the time for compiling machine code.
    warm : Result, array of shape (n,), or path
        Warm start of an optimisation: a result on any grid, its `unknowns`, or a file that `--save` has written.
    doublings : int
        Number of further solves, on 2 N, 4 N, ... intervals, each from the solution before.
    accuracy : float
        Relative error of states and cost; grids are refined, or a simulation takes more steps, until the estimated
        error is smaller. Without the option `scheme` the scheme is gauss-4, or the scheme of the problem if it has path
        inequalities.
    guesses : int
        Number of initial guesses: the guess of the problem, then random variations. The best solution is returned.
    sensitivities : bool
        Compute `result.sensitivities()`; a separate module is built.
    points : path or PointSet
        Starts and targets (n, d) and standard deviations (n,) of particles; by default the file of the problem.
    parameters : dict
        Parameter overrides without a new build, also of durations and prescribed ends, as in
        {"m": 2.0, "duration": 3.0, "start.x": 1.0}. `Solver.parameters` lists the names.
    tables : dict
        Other files for tables by name, with the same columns and the same number of breakpoints.
    observations : path, or dict of arrays of shape (n,)
        Other measurements; for several bodies a list with an entry for each.
    tolerance : float
        Tolerance of equations relative to their scale; for particles the tolerance of the arrival, or of adaptive
        steps.
    max_iterations, time_limit : int, float
        Largest number of iterations of one search; time limit in seconds for all guesses and grids of one run.
    scaling : {"auto", "none"}
        "auto" computes scaling factors for the driver newton; "none" keeps the units of the problem.
    log, watch : bool, callable
        If `log` is True, a driver without a log of iterates raises ArgumentError. `watch` is called at every iterate
        with the number of the iterate and its row of the log.

    Returns
    -------
    Result
        `status` is "solved" only if all equations hold when they are evaluated independently of the driver. A numerical
        failure gives another status and a `message`, not an exception.

    Raises
    ------
    CodegenError
        ArgumentError for an option that does not exist or apply, NumericsError for an unusable number, and other kinds
        for a problem that cannot be read, derived or stored.

    Notes
    -----
    Several threads may call the function at once. Sources: Marsden and West (2001), Discrete mechanics and variational
    integrators, for the equations; Waechter and Biegler (2006) for the optimiser; Betts (2010), section 4.7, for the
    refinement of grids.
    """
    require_options(options)
    from codegen.solving.outcome import outcome_of
    from codegen.solving.progress import building

    try:
        request = Request(*positional, **options)
    except TypeError as error:  # a missing, surplus or repeated argument
        text = str(error).replace("Request.__init__()", "codegen.solve")
        raise ArgumentError(text, "give a problem, a driver if it is not newton, and options by name") from None
    return outcome_of(request, building).for_python
