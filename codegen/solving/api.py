"""Solving: one request, from a problem's file or its module, and one outcome."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ParamSpec

from codegen.errors import ArgumentError
from codegen.solving.request import Request, require_known

if TYPE_CHECKING:
    from codegen.solving.results.result import Result

Given = ParamSpec("Given")


def _taking(request: Callable[Given, Request]) -> Callable[[Callable[..., Result]], Callable[Given, Result]]:
    """Give a function the arguments of a request, so that their list stands in one place."""

    def decorated(function: Callable[..., Result]) -> Callable[Given, Result]:
        signature = inspect.signature(request).replace(return_annotation="Result")
        setattr(function, "__signature__", signature)  # noqa: B010  functions are not declared to have one
        return function

    return decorated


@_taking(Request)
def solve(*positional: Any, **options: Any) -> Result:
    """Solve a problem, building and compiling its module first where that is necessary, and judge what was found.

    `problem` is the path of a problem file or of a generated module, a module from `codegen.load`, a Control or another
    object that a problem file may return, or a solver from `codegen.compile`; `driver` is newton (the generated
    solver), slsqp, trust-constr, ipopt, fsolve or fmin. For a problem file, and but for `arguments` for an object:

    - `arguments`: a dict of arguments of problem(), as `--set` has them, by name;
    - `scheme`, `method`, `controls`, `out`: as for `codegen.build`.

    For all problems:

    - `steps`: the number of intervals N; by default the problem's own;
    - `repeat`: the time is the least of so many solves, without the time in which numba compiles or reads machine code;
    - `parameters`: a dict of values, by name, in place of those that the problem gives its parameters, a `duration`
      that is given, prescribed ends of an optimisation and the start of a simulation, as in
      `{"m": 2.0, "duration": 3.0, "start.x": 1.0}`; nothing is built anew. Particles start from an array, which has no
      names, and those that are connected have no such values at all.

    For problems with tables, `tables` maps their names to other files of the same columns, with as many breakpoints;
    nothing is built anew. For problems with measurements `observations` are others in the same columns, any number of
    them: a file, or a mapping of columns to arrays of shape (n,), of several bodies a list of these.

    For an optimisation:

    - `warm`: the `unknowns` of an earlier result to start from, shape (n,), on any grid, or a file of `--save`;
    - `doublings`: solve again on 2 N, 4 N, ... intervals, so often, each time from the solution before;
    - `accuracy`: choose intervals of different lengths, ever more of them, until the estimated relative error of states
      and cost is below it; `accuracy` of the result tells how, and the scheme is gauss-4 where none is given, or the
      problem's own where there are path inequalities;
    - `guesses`: start from the problem's own guess and from variations of it, so many in all, and keep the best;
    - `tolerance`: of the equations, in parts of their sizes; `max_iterations` and `time_limit`, in seconds for all
      guesses and grids together and for each of `repeat` solves by itself; by default the driver's own;
    - `sensitivities`: of the result, `result.sensitivities()`: derivatives by parameters, boundary values and a given
      duration, for which a module of its own is built;
    - `scaling`: of newton, "auto", or "none" for work in the problem's own units;
    - `log`: refuse drivers that keep no log; `watch`: called at every iterate of newton with its number and its row.

    For a simulation `every` stores every so many-th step, and `max_iterations` limits Newton's method in a step. For
    particles that are connected, `points` is a file of points, or a PointSet with start and target of shape (n, d) and
    sigma of shape (n,), by default the problem file's own; `tolerance` is that of an arrival, or of adaptive steps.

    The result's `t` has shape (M + 1,), and `q`, `p`, `u` a row for each time (`u` for each of `control_times`), with a
    column for each of `names`; `status` is "solved" only if all equations hold when they are evaluated again outside
    the driver, and numerical failure is a status with its reason in `message`, not an exception. All quantities are in
    the units of the problem file. Calls from several threads are safe; derivations take turns.

    Raises ArgumentError for an option, driver, scheme or argument that does not exist or does not apply, NumericsError
    for an unusable number, and another kind of CodegenError when the problem cannot be read, derived or stored. Source:
    Marsden and West (2001), Discrete mechanics and variational integrators, for the equations; Waechter and Biegler
    (2006) for the optimiser; Betts (2010), section 4.7, for finer grids.
    """
    require_known(options)
    from codegen.solving.outcome import outcome_of

    try:
        request = Request(*positional, **options)
    except TypeError as error:  # none, too many, or twice
        text = str(error).replace("Request.__init__()", "codegen.solve")
        raise ArgumentError(text, "give a problem, a driver if it is not newton, and options by name") from None
    return outcome_of(request).result
