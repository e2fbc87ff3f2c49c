"""Look-ups of tables as a text has them, at numbers and indices of its own, against the tables themselves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from codegen.errors import VerificationError
from codegen.tables.data import TableData
from codegen.tables.evaluation import ORDERS, derivative
from codegen.verify.execution import Text

_POINTS = 6
_TOLERANCE = 1e-9


def verify_tables(tables: Sequence[TableData], first: int, text: Text) -> None:
    """Execute each look-up, whose numbers stand from `first` on; VerificationError names a derivative that is wrong."""
    if not tables:
        return
    module = text.interpreted("TABLES", *(table.shape.lookup for table in tables))
    numbers = np.concatenate([np.full(first, np.nan), *module["TABLES"].values()])
    for table in tables:
        orders = ORDERS[len(table.shape.sizes)]
        for point in _points(table):
            found = module[table.shape.lookup](numbers, *point)
            for order, value in zip(orders, found, strict=True):
                right = float(derivative(table, order, point, lambda x: x))
                if not abs(value - right) <= _TOLERANCE * _size(table, order):
                    raise VerificationError(
                        f"the emitted code gives {value:.8g} for derivative {order} of table {table.shape.name}, where "
                        f"{right:.8g} is right",
                        "this is a defect of codegen, and nothing was written; please report it with the problem file",
                    )


def _points(table: TableData) -> Iterator[list[float]]:
    """Points inside the table's range, and beyond it by a tenth of that."""
    generator = np.random.default_rng(11)
    for _ in range(_POINTS):
        yield [float(axis[0] + generator.uniform(-0.1, 1.1) * np.ptp(axis)) for axis in table.axes]


def _size(table: TableData, order: Sequence[int]) -> float:
    """How large a derivative is, by values and slopes and the widths of cells."""
    size = float(np.abs(table.heights).max()) * max(1.0, *(float(np.ptp(axis)) for axis in table.axes))
    for axis, o in zip(table.axes, order, strict=True):
        size /= float(np.diff(axis).min(initial=1.0)) ** o
    return size
