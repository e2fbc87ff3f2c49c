"""The numbers of tables: those of the module, or others instead."""

import numpy as np

from codegen.runtime.stand_ins.example_tables import TABLES, metadata


def table_numbers(given):
    """The numbers of all tables, one after the other, of those in `given` as they stand there.

    ValueError for a table that there is not, for other numbers of breakpoints, and for breakpoints out of order.
    """
    for name in given or {}:
        if name not in TABLES:
            raise ValueError(f"there is no table {name!r}; there are: {', '.join(TABLES)}")
    return np.concatenate([checked_table(name, (given or {}).get(name, own)) for name, own in TABLES.items()])


def checked_table(name, numbers):
    """The numbers of a table, shape (n,): breakpoints, then what stands at them."""
    own, sizes = TABLES[name], metadata["tables"][name]["sizes"]
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
