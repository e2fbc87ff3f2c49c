"""Measurements as kernels read them: of each sample the interval in which it lies, and the place in it."""

import numpy as np

TIME_ROUNDING = 1e-9  # parts of the duration by which a time may be outside


def with_tables(grid, tables):
    """Return the grid with the numbers of all tables behind its parameters; `tables` as in `solve`."""
    from codegen.runtime.tabulated.table_numbers import table_numbers

    rows = np.tile(table_numbers(grid.problem, tables), (grid.problem.structure.bodies, 1))
    return grid._replace(parameters=np.hstack([grid.parameters, rows]))


def with_observations(grid, observations):
    """Return the grid with the samples of each body behind its parameters; `observations` as in `solve`."""
    bodies = grid.problem.structure.bodies
    given = grid.problem.observations if observations is None else observations
    if isinstance(given, np.ndarray):
        given = (given,)
    if len(given) != bodies:
        raise ValueError(f"there are observations of {len(given)} bodies, and {bodies} move")
    rows = [samples_of(grid, checked_observations(grid.problem, measured)) for measured in given]
    samples = np.full((bodies, max(own.size for own in rows)), np.inf)  # where there are fewer, none begins
    for body, own in enumerate(rows):
        samples[body, : own.size] = own.ravel()
    return grid._replace(parameters=np.hstack([grid.parameters, samples]))


def checked_observations(problem, measured):
    """Return rows (time, values, standard deviations) of one body by time; ValueError for anything else."""
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
    """Return the samples (m, sample) for kernels of rows by time; ValueError for times outside the motion."""
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


def through_samples(grid, values, column, at_start, at_end):
    """Return values (bodies, N + 1) at nodes, on straight lines between what was measured in a column, or its means.

    They stay as they are `at_start` and `at_end`, where that is true, and in bodies of which it was not measured.
    """
    times, led, s = grid.nodes * grid.h, values.copy(), grid.problem.structure
    for body in range(s.bodies):
        samples = grid.parameters[body, s.first_sample :].reshape(-1, s.sample)
        samples = samples[samples[:, 2 + column + (s.sample - 2) // 2] > 0.0]  # with a weight of their own
        samples = samples[np.isfinite(samples[:, 0])]
        if samples.size:
            k = np.searchsorted(times, samples[:, 0]) - 1
            at, index = np.unique(times[k] + samples[:, 1] * (times[k + 1] - times[k]), return_inverse=True)
            measured = np.bincount(index, samples[:, 2 + column]) / np.bincount(index)
            led[body] = np.interp(times, at, measured)
        if at_start:
            led[body, 0] = values[body, 0]
        if at_end:
            led[body, -1] = values[body, -1]
    return led
