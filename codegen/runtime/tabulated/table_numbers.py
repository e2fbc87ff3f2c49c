"""The numbers of tables: those of the problem, or others instead."""

import numpy as np


def table_numbers(problem, given):
    """Return the numbers of all tables, one after the other, of those in `given` as they stand there.

    ValueError for an unknown table, for other numbers of breakpoints, and for breakpoints out of order.
    """
    for name in given or {}:
        if name not in problem.tables:
            raise ValueError(f"there is no table {name!r}; there are: {', '.join(problem.tables)}")
    return np.concatenate(
        [checked_table(problem, name, (given or {}).get(name, own)) for name, own in problem.tables.items()]
    )


def checked_table(problem, name, numbers):
    """Return the numbers of a table, shape (n,): breakpoints, then what stands at them."""
    own, sizes = problem.tables[name], problem.metadata.tables[name].sizes
    if numbers is own:
        return own
    numbers = np.array(numbers, dtype=float)
    if numbers.shape != own.shape:
        raise ValueError(f"table {name} is of shape {numbers.shape}, and the module is made for {own.shape}")
    if not np.isfinite(numbers).all():
        raise ValueError(f"table {name} has a number that is not finite")
    for axis in np.split(numbers[: sum(sizes)], np.cumsum(sizes)[:-1]):
        if not (np.diff(axis) > 0.0).all():
            raise ValueError(f"the breakpoints of table {name} do not ascend: {axis}")
    return numbers
