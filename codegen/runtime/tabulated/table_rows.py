"""Tables of an optimisation: their numbers stand behind the parameters of each body, where kernels read them."""

import numpy as np

from codegen.runtime.stand_ins.example import BODIES
from codegen.runtime.tabulated.table_numbers import table_numbers


def with_tables(grid, tables):
    """The grid with the numbers of all tables behind its parameters; `tables` as in `solve`."""
    rows = np.tile(table_numbers(tables), (BODIES, 1))
    return grid._replace(parameters=np.hstack([grid.parameters, rows]))
