"""Many solves of one problem: a grid, a table or samples of cases, shared between processes, as one data set."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

from codegen.errors import ArgumentError
from codegen.sweeping.request import sweep_request

if TYPE_CHECKING:
    from xarray import Dataset


def sweep(*positional: Any, **options: Any) -> Dataset:
    """Solve a problem for many values of its parameters, and return all solutions as one xarray.Dataset.

    `problem` is as for `codegen.solve`. Cases are given in one of three ways:

    - `vary`: a dict of names and arrays (n,), all of whose combinations are cases; those in one of the groups `zipped`,
      such as `[("m", "r0")]`, vary together. The data set has a dimension for each quantity, or group;
    - `cases`: a file of comma-separated values, or a mapping of names to columns (n,): a case for each row;
    - `samples`: a dict of names and distributions, such as `normal(100, 5)`, `uniform(4.9, 5.1)` (from, to), any of
      scipy.stats by its name and arguments, or one that scipy has frozen; then `cases` is their number, 1000 unless
      said, `method` is random, latin or sobol, and the same `seed` gives the same samples.

    What varies are run-time parameters of the module, durations, prescribed values (`start.r`, `end.phi`), `steps`, and
    arguments of problem(), for each of whose values a module is built.

    - `out`: a zarr store (.zarr), written chunk by chunk, or a file of netCDF (.nc); what is there already is never
      overwritten. `resume` goes on with a store that was begun by the same sweep;
    - `keep`: which of t, q, p, u, multipliers and energy are kept of each case, unless said all, or t, q and u where
      all would take more than 250 MB of all cases, before they are compressed; with `sensitivities` also of d_t, d_q,
      d_p, d_u and d_multipliers, their derivatives;
    - `workers`: how many processes share the work, unless said as many as there are processors. Results do not depend
      on it. With `spawn` as the only way to start a process, a script needs its `if __name__ == "__main__"`;
    - `cluster`: the address of a scheduler of dask, a `distributed.Client`, or "local", for workers of a cluster;
    - `warm_starts`: whether an optimisation begins from its last solved neighbour, which takes fewer iterations where
      solutions change little, but stays with its local optimum. Otherwise it begins from the problem's own guess, and
      only where that fails from neighbours. With `sensitivities` the start follows the tangent at that neighbour, else
      the secant through the last two on a straight part of the path;
    - `sensitivities`: whether derivatives of the cost by all parameters, prescribed values and a given duration are
      kept, as `codegen.solve` finds them; those that vary follow no others;
    - `chunk`: how many cases are solved and written together, unless said about a second of work;
    - `driver`, `arguments`, `scheme`, `formulation` (the `method` of a solve), `controls`, `steps`, `every`,
      `tolerance`, `max_iterations`, `time_limit` and `scaling`: as for `codegen.solve`, the same for all cases.

    The data set has t (..., node), q and p (..., node, names), u and multipliers on nodes or intervals, padded with
    NaN where `steps` vary; cost, residual (evaluated again outside the driver), iterations and seconds of all
    attempts at a case, status and message; free parameters by their names; with sensitivities d_cost (..., by),
    likewise d_T of a free parameter T, and d_q (..., by, node, names), NaN where d_message says why there are none;
    of optimisations whose guesses do not vary `improvement`, what a case has won by a start from beyond a jump of the
    cost, and `jump`, 1 where a better neighbour is left. A case that fails is a row with these, and NaN in cost and
    arrays. All quantities are in the units of the problem file.

    Raises ArgumentError for names and options that do not exist or do not apply, ExtraError without xarray and zarr, or
    dask for a cluster, ClusterError when its scheduler does not answer, has no workers or is lost, and what
    `codegen.solve` raises for a problem that cannot be read, derived or stored.
    """
    from codegen.sweeping.outcome import outcome_of

    try:
        inspect.signature(sweep_request).bind(*positional, **options)
    except TypeError as error:  # none, too many, or twice
        raise ArgumentError(f"codegen.sweep: {error}", "give a problem, what varies, and options by name") from None
    return outcome_of(sweep_request(*positional, **options)).dataset()


setattr(sweep, "__signature__", inspect.signature(sweep_request).replace(return_annotation="Dataset"))  # noqa: B010
