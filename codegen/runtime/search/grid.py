"""The time grid of a solve with all its data, views of the unknowns, inner times and measurements.

Kernels receive a measurement as a sample: its interval, its position in the interval, measured values and weights.
"""

import math
from typing import NamedTuple

import numpy as np

from codegen.runtime.search.problem import ControlProblem

LEAST_SQUARE = 1e-12  # least square of the length of a gradient, relative to the sum of all
NONE = np.zeros(0)  # the scaling factors of a grid in the problem's own units
SHORTEST = 1e-10  # least length of an interval, relative to the duration or the phase
EQUAL = 1e-12  # largest relative difference of the lengths of equal intervals
SUM_ROUNDING = 1e-6  # largest difference of the sum of all fractions from one
TIME_ROUNDING = 1e-9  # largest excess of a measured time, relative to the duration
AT_NODE = 1e-9  # largest distance of a node from its inner time, relative to the duration


class Grid(NamedTuple):
    """The N intervals of a problem, with parameters, scaling factors and bounds.

    Attributes
    ----------
    steps, h : int, float
        The number N of intervals, and their mean length.
    nodes : (N + 1,)
        Times of the nodes from the start, in mean lengths of an interval.
    is_uniform : bool
        True if all intervals have the mean length.
    parameters : (bodies, P + shared)
        Parameters of each body. Each evaluation fills the last columns with the linking variables of the body. Numbers
        of tables, and samples of measurements, may follow.
    is_multiplier : (n,)
        Mask of the multipliers among all unknowns.
    sizes, forces, weight : (n,), (n,), float
        Scaling factors. Unknowns are divided by `sizes`. The cost is multiplied by `weight`, and the gradient by
        `forces`, which is weight times sizes. In the problem's own units, `sizes` and `forces` are empty and `weight`
        is 1.
    bounds : tuple
        Least and greatest values (n,) of the scaled unknowns; empty before they are computed.
    inner : tuple of int
        Indices of the nodes at inner times.
    problem : ControlProblem
        The problem.
    """

    steps: int
    h: float
    nodes: np.ndarray
    is_uniform: bool
    parameters: np.ndarray
    is_multiplier: np.ndarray
    sizes: np.ndarray
    forces: np.ndarray
    weight: float
    bounds: tuple[np.ndarray, ...]
    inner: tuple[int, ...]
    problem: ControlProblem

    @property
    def structure(self):
        """The structure of the problem."""
        return self.problem.structure


def checked_count(name, number):
    """Return `number`, which may be a float such as 10.0, as a positive integer; raise ValueError for anything else."""
    try:
        is_count = number == int(number) and number >= 1 and not isinstance(number, bool)
    except (TypeError, ValueError, OverflowError):
        is_count = False
    if not is_count:
        raise ValueError(f"{name} is {number!r}, expected a positive integer")
    return int(number)


def checked_tolerance(tolerance, most):
    """Return `tolerance` as a float if it is above zero and at most `most`; raise ValueError otherwise."""
    try:
        is_tolerance = 0.0 < tolerance <= most
    except TypeError:
        is_tolerance = False
    if not is_tolerance:
        raise ValueError(f"tolerance is {tolerance!r}, expected a number between 0 and {most:g}")
    return float(tolerance)


def checked_times(steps, duration):
    """Return (steps, duration); raise ValueError unless both are positive and finite."""
    steps = checked_count("steps", steps)
    if not 0.0 < duration < np.inf:
        raise ValueError(f"duration is {duration!r}, expected a positive number")
    return steps, float(duration)


def checked_grid(problem, steps, duration, parameters, fractions):
    """Return the Grid of a problem in its own units.

    `parameters` is a sequence of numbers, or of arrays (bodies,) for values that differ between bodies. `fractions` are
    relative lengths of intervals, see `checked_nodes`. Raise ValueError for a value that is not finite, or that should
    be positive and is not.
    """
    s = problem.structure
    steps, duration = checked_times(steps, duration)
    steps, nodes, is_uniform = checked_nodes(s.phases or 1, steps, fractions)
    table = np.zeros((s.bodies, len(parameters) + s.shared))  # linking variables follow the parameters
    numbers = [value if isinstance(value, (int, float)) else 0.0 for value in parameters]
    table[:, : len(parameters)] = numbers
    finite = all(map(math.isfinite, numbers))
    for i, value in enumerate(parameters):
        if value is not numbers[i]:  # differs from body to body
            table[:, i] = value
            finite = finite and all(map(math.isfinite, table[:, i].tolist()))
    if not finite:
        raise ValueError(f"parameters and boundary values must be finite, got {table}")
    if s.phases:
        steps, duration = s.phases * steps, s.phases  # each phase counts as one unit of time
    is_multiplier = s.layouts(steps).is_multiplier.copy()  # writable, so that numba compiles for one type
    return Grid(steps, duration / steps, nodes, is_uniform, table, is_multiplier, NONE, NONE, 1.0, (), (), problem)


def checked_nodes(chains, steps, fractions):
    """Return (number of intervals of one phase, times of all nodes in mean lengths, True if all intervals are equal).

    `fractions` (N,) are the lengths of the intervals relative to the duration, or None for equal intervals. With
    several phases, `chains` is their number. The fractions are then relative to each phase, and may be (chains, N).
    Raise ValueError for other shapes, or if the sum is not one.
    """
    if fractions is None:
        return steps, np.arange(chains * steps + 1.0), True
    lengths = np.array(fractions, dtype=float)
    if lengths.ndim == 1:
        lengths = np.tile(lengths, (chains, 1))
    if lengths.ndim != 2 or lengths.shape[0] != chains or not lengths.size:
        shape = "(N,)" if chains == 1 else f"(N,) or ({chains}, N)"
        raise ValueError(f"grid has shape {np.shape(fractions)}, expected {shape}")
    if not (lengths > SHORTEST).all() or (np.abs(lengths.sum(axis=1) - 1.0) > SUM_ROUNDING).any():
        raise ValueError(f"grid must hold fractions above {SHORTEST:g} whose sum is one, got {fractions!r}")
    steps = lengths.shape[1]
    if np.ptp(lengths) <= EQUAL / steps:
        return steps, np.arange(chains * steps + 1.0), True
    ends = np.cumsum(lengths, axis=1)
    indices = steps * (ends / ends[:, -1:] + np.arange(chains)[:, None])
    return steps, np.concatenate([[0.0], indices.ravel()]), False


def plain_grid(grid):
    """Return `grid` without scaling factors, in the problem's own units."""
    return grid._replace(sizes=NONE, forces=NONE, weight=1.0, bounds=())


def replace_values(boundary, where, values):
    """Replace prescribed values in `boundary`, whose keys are `start x` or `end x`, by `values`, a mapping by name.

    `where` is `start` or `end`. Raise ValueError for a quantity that is not prescribed there.
    """
    for quantity, value in (values or {}).items():
        key = f"{where} {quantity}"
        if key not in boundary:
            known = ", ".join(name.split()[1] for name in boundary if name.startswith(where)) or "nothing"
            raise ValueError(f"{quantity!r} is not prescribed at the {where}; prescribed: {known}")
        boundary[key] = np.asarray(value, dtype=float)


def views(grid, unknowns):
    """Return two views of `unknowns` (n,): nodes (bodies, N + 1, node) and intervals (bodies, N, stride - node).

    Unknowns (n, k) of k cases give views with one more axis.
    """
    s = grid.problem.structure
    item, chain, cases = unknowns.strides[0], grid.steps * s.stride + s.node, unknowns.shape[1:]
    strides = chain * item, s.stride * item, item, *unknowns.strides[1:]
    nodes = np.ndarray((s.bodies, grid.steps + 1, s.node, *cases), float, unknowns, 0, strides)
    intervals = np.ndarray((s.bodies, grid.steps, s.stride - s.node, *cases), float, unknowns, s.node * item, strides)
    return nodes, intervals


def shared_views(grid, unknowns):
    """Return two views of the linking variables: (bodies, own) for single bodies, and 1-D for the whole problem."""
    s = grid.problem.structure
    first = len(unknowns) - s.root
    own = unknowns[first : first + s.bodies * s.own].reshape(s.bodies, s.own, *unknowns.shape[1:])
    return own, unknowns[first + s.bodies * s.own : len(unknowns) - s.couplings]


def side_by_side(values):
    """Return `values` (bodies, times, m) as an array (times, bodies m), with the columns of all bodies side by side."""
    if len(values) > 1:
        return values.transpose(1, 0, 2).copy().reshape(values.shape[1], -1)
    return values[0].copy()


def layout_of(grid):
    """Return the Layout of a grid: masks and indices of multipliers and of free unknowns."""
    s = grid.problem.structure
    return s.inner_layouts(grid.steps, grid.inner) if s.inner_times else s.layouts(grid.steps)


def free_unknowns(grid):
    """Return the mask (n,) of the unknowns that exist and that no boundary condition prescribes."""
    return layout_of(grid).is_free


def primal_unknowns(grid):
    """Return the indices of the free primal unknowns."""
    return layout_of(grid).primal


def multiplier_unknowns(grid):
    """Return the indices of the multipliers that have an equation, see `free_unknowns`."""
    return layout_of(grid).multipliers


def with_pinned_values(grid, unknowns):
    """Return a copy of `unknowns` (n,) with the values that boundary conditions prescribe.

    Raise ValueError for another shape.
    """
    unknowns = np.array(unknowns, dtype=float)
    if unknowns.shape != grid.is_multiplier.shape:
        raise ValueError(f"guess has shape {unknowns.shape}, expected {grid.is_multiplier.shape}")
    grid.problem.pin_values(grid, unknowns, views(grid, unknowns)[0])
    return unknowns


def node_times(grid, unknowns):
    """Return the times (N + 1,) of all nodes of a problem with several phases, which follow each other."""
    phases = grid.problem.structure.phases
    switches = np.concatenate([[0.0], np.cumsum(grid.problem.phase_durations(grid, unknowns))])
    return np.interp(grid.nodes / (grid.steps // phases), np.arange(phases + 1), switches)


def interval_times(grid, unknowns, fraction=0.5):
    """Return the times (N,) at a fraction of all intervals of a problem with several phases; default: midpoints."""
    t = node_times(grid, unknowns)
    return (1.0 - fraction) * t[:-1] + fraction * t[1:]


def least_duration(grid, unknowns):
    """Return the duration of the motion, or of the shortest phase."""
    if grid.problem.phase_durations is not None:
        return grid.problem.phase_durations(grid, unknowns).min()
    return grid.problem.duration_of(grid, unknowns)


def inner_fractions(steps, duration, times, fractions):
    """Return the lengths (N,) of intervals relative to the duration, such that all inner `times` are nodes.

    `fractions` are lengths that the caller prescribes, or None. Raise ValueError if nodes of prescribed lengths miss an
    inner time, if `steps` is too small, or if the times do not ascend between start and end.
    """
    steps, duration = checked_times(steps, duration)
    ends = np.array([*times, duration], dtype=float) / duration
    lengths = np.diff(ends, prepend=0.0)
    if not (lengths > AT_NODE).all():
        raise ValueError(f"inner times must ascend from 0 to the duration, got {list(times)} in {duration:g}")
    if fractions is not None:
        nodes = np.cumsum(np.ravel(np.asarray(fractions, dtype=float)))
        missed = [time for time, end in zip(times, ends, strict=False) if not (np.abs(nodes - end) < AT_NODE).any()]
        if missed:
            raise ValueError(f"grid must have a node at the inner time {missed[0]:g}")
        return fractions
    if steps < lengths.size:
        raise ValueError(f"steps must be at least {lengths.size}, as {len(times)} inner times are nodes, got {steps}")
    # Each segment between inner times gets at least one interval. The segment with the longest intervals gets the next.
    counts = np.maximum(1, np.floor(steps * lengths * (1.0 + AT_NODE)).astype(np.int64))
    while counts.sum() > steps:
        counts[np.argmin(np.where(counts > 1, lengths / counts, np.inf))] -= 1
    while counts.sum() < steps:
        counts[np.argmax(lengths / counts)] += 1
    return np.repeat(lengths / counts, counts)


def with_inner_times(grid):
    """Return the grid with the indices of the nodes at inner times.

    The inner times among its parameters become exactly the times of these nodes.
    """
    s = grid.problem.structure
    place = slice(s.inner_first, s.inner_first + s.inner_times)
    numbers = np.abs(grid.nodes[:, None] * grid.h - grid.parameters[0, place]).argmin(axis=0)
    grid.parameters[:, place] = grid.nodes[numbers] * grid.h
    return grid._replace(inner=tuple(numbers.tolist()))


def through_inner_times(grid, values, numbers, wanted, at_start, at_end):
    """Return `values` (bodies, N + 1) of a quantity at nodes, shifted to the `wanted` values at inner times.

    The shift is piecewise linear. `numbers` are the numbers of the inner times, and `wanted` has one value, or an array
    (bodies,), for each of them. If `at_start` or `at_end` is True, the value at this end stays the same.
    """
    inner, shifted = [grid.inner[number] for number in numbers], values.copy()
    nodes = np.concatenate([[0] * at_start, inner, [grid.steps] * at_end]).astype(np.int64)
    for body in range(len(values)):
        targets = np.array([np.ravel(value)[body % np.size(value)] for value in wanted])
        shifts = np.concatenate([[0.0] * at_start, targets - values[body, inner], [0.0] * at_end])
        shifted[body] += np.interp(grid.nodes, grid.nodes[nodes], shifts)
    return shifted


def holding_forces(forces, gradients):
    """Return the constraint forces kappa (..., m) with the least |F + G^T kappa|, zero where the force F is not finite.

    `forces` are the n components of F, and `gradients` the m rows of G, numbers or arrays (...). Forces along gradients
    that vanish or depend on each other are small.
    """
    arrays = np.broadcast_arrays(*forces, *(entry for row in gradients for entry in row))
    n, m = len(forces), len(gradients)
    force = np.stack(arrays[:n], axis=-1)
    rows = np.stack(arrays[n:], axis=-1).reshape(*force.shape[:-1], m, n)
    products = rows @ rows.swapaxes(-1, -2)
    size = np.trace(products, axis1=-2, axis2=-1)[..., None, None]
    right = np.nan_to_num(rows @ force[..., None], nan=0.0, posinf=0.0, neginf=0.0)
    return -np.linalg.solve(products + np.where(size > 0.0, LEAST_SQUARE * size, 1.0) * np.eye(m), right)[..., 0]


def without_inner_unknown(grid, number):
    """Return the mask (N + 1,) of the nodes that lack an unknown, given by its index in `Structure.inner_unknowns`."""
    absent = np.ones(grid.steps + 1, bool)
    absent[np.array(grid.inner)[grid.problem.structure.inner_present[:, number]]] = False
    return absent


def with_tables(grid, tables):
    """Return the grid with the numbers of all tables behind its parameters.

    `tables` maps names of tables to arrays that replace the default numbers, or is None.
    """
    from codegen.runtime.tabulated import table_numbers

    rows = np.tile(table_numbers(grid.problem, tables), (grid.problem.structure.bodies, 1))
    return grid._replace(parameters=np.hstack([grid.parameters, rows]))


def with_observations(grid, observations):
    """Return the grid with the samples of the measurements of each body behind its parameters.

    `observations` has an array of rows (time, values, standard deviations) for each body, or is None for the default
    ones.
    """
    bodies = grid.problem.structure.bodies
    observations = grid.problem.observations if observations is None else observations
    if isinstance(observations, np.ndarray):
        observations = (observations,)
    if len(observations) != bodies:
        raise ValueError(f"there are observations of {len(observations)} bodies, and {bodies} move")
    rows = [samples_of(grid, checked_observations(grid.problem, measured)) for measured in observations]
    samples = np.full((bodies, max(row.size for row in rows)), np.inf)  # an infinite time ends the samples of a body
    for body, row in enumerate(rows):
        samples[body, : row.size] = row.ravel()
    return grid._replace(parameters=np.hstack([grid.parameters, samples]))


def checked_observations(problem, measured):
    """Return the measurements of one body, rows of (time, values, standard deviations), sorted by time.

    Raise ValueError for unusable rows.
    """
    rows, width = np.array(measured, dtype=float), problem.structure.sample - 1
    if rows.ndim != 2 or rows.shape[1] != width or not rows.size:
        columns = ", ".join(problem.metadata.observations.columns)
        raise ValueError(f"observations have shape {rows.shape}, expected rows of time, {columns}, standard deviations")
    values, sigmas = np.split(rows[:, 1:], 2, axis=1)
    if not np.isfinite(rows[:, 0]).all() or np.isinf(values).any():
        raise ValueError("observations must have finite times and values, NaN where nothing was measured")
    if not (np.isnan(values) | (sigmas > 0.0) & (sigmas < np.inf)).all():
        raise ValueError("standard deviations of observations must be positive and finite")
    return rows[np.argsort(rows[:, 0], kind="stable")]


def samples_of(grid, rows):
    """Return the samples (m, sample) of measurements for kernels; raise ValueError for times outside the motion.

    `rows` are the measurements sorted by time. A sample has the time of the middle of its interval, and the position in
    the interval from 0 to 1. Then follow the values, and their inverse standard deviations, which are zero for missing
    values.
    """
    nodes = grid.nodes * grid.h
    least, greatest = rows[0, 0], rows[-1, 0]
    if least < -TIME_ROUNDING * nodes[-1] or greatest > (1.0 + TIME_ROUNDING) * nodes[-1]:
        raise ValueError(f"observations are from t = {least:g} to {greatest:g}, the motion from 0 to {nodes[-1]:g}")
    k = np.clip(np.searchsorted(nodes, rows[:, 0], side="right") - 1, 0, grid.steps - 1)
    values, sigmas = np.split(rows[:, 1:], 2, axis=1)
    missing = np.isnan(values)
    return np.column_stack(
        [
            (nodes[k] + nodes[k + 1]) / 2.0,
            np.clip((rows[:, 0] - nodes[k]) / (nodes[k + 1] - nodes[k]), 0.0, 1.0),
            np.where(missing, 0.0, values),
            np.where(missing, 0.0, 1.0 / np.where(missing, 1.0, sigmas)),
        ]
    )


def through_samples(grid, values, column, at_start, at_end, offset=0.0, slope=1.0):
    """Return `values` (bodies, N + 1) of a quantity at nodes, replaced by linear interpolation of its measurements.

    The measured values of `column` are `offset` plus `slope` times the quantity; both are numbers, or (bodies, 1). The
    mean represents several measurements at the same time. If `at_start` or `at_end` is True, the value at this end
    stays the same. Values of bodies without measurements stay the same, too.
    """
    times, interpolated, s = grid.nodes * grid.h, values.copy(), grid.problem.structure
    offsets, slopes = (np.broadcast_to(numbers, (s.bodies, 1))[:, 0] for numbers in (offset, slope))
    for body in range(s.bodies):
        samples = grid.parameters[body, s.first_sample :].reshape(-1, s.sample)
        samples = samples[samples[:, 2 + column + (s.sample - 2) // 2] > 0.0]  # without missing values
        samples = samples[np.isfinite(samples[:, 0])]
        if samples.size:
            k = np.searchsorted(times, samples[:, 0]) - 1
            at, index = np.unique(times[k] + samples[:, 1] * (times[k + 1] - times[k]), return_inverse=True)
            measured = np.bincount(index, samples[:, 2 + column]) / np.bincount(index)
            interpolated[body] = (np.interp(times, at, measured) - offsets[body]) / slopes[body]
        if at_start:
            interpolated[body, 0] = values[body, 0]
        if at_end:
            interpolated[body, -1] = values[body, -1]
    return interpolated
