"""Entries of arrays in compiled functions: the same values as in Python, by less intermediate code."""

import numpy as np
import pytest
from llvmlite import ir
from numba import njit
from numba.core import types

from codegen.machine_code.shortcuts import quick_numba


def exchange(line, table, block, order, marks, strided):
    """Read and write by all kinds of indices: from the end, from lists, constant, in arrays of other kinds."""
    total = 0.0
    for i in range(-line.size, line.size):
        line[i] += i
        total += line[i] * line[order[i]]
    for i in range(table.shape[0]):
        for j in range(-1, -table.shape[1] - 1, -1):
            table[i, j] = table[-i, j] + line[-1]
            total += block[i, j, order[0]] * table[order[i], 1]
            block[-1, j, i] = total
    for i in range(marks.size):
        marks[i] = not marks[i - 1]
        strided[i] = total + i
        order[i] = order[i - 1] + i
        if marks[i] and table[i][1] > 0.0:
            total -= strided[-i - 1] + line[1:][i] + block[0][i, 2]
    return total


def arguments():
    random = np.random.default_rng(3)
    line, table, block = random.normal(size=4), random.normal(size=(3, 3)), random.normal(size=(3, 3, 4))
    return line, table, block, np.array([2, 0, 1, 0]), random.normal(size=3) > 0.0, np.zeros((3, 2))[:, 0]


def test_all_kinds_of_indices_mean_what_they_mean_in_python():
    wanted, found = arguments(), arguments()
    with quick_numba():
        assert njit(exchange)(*found) == pytest.approx(exchange(*wanted), rel=1e-14)
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-14)


@pytest.mark.parametrize("kind", [types.uint64, types.int64])
def test_entries_take_little_intermediate_code(kind, monkeypatch):
    """Less than where rows are columns, which is left to numba; it writes the same for both."""

    def exchanged(table, first, second):
        table[first, second] = table[second, first]

    made: list[None] = []
    own = ir.Instruction.__init__
    monkeypatch.setattr(ir.Instruction, "__init__", lambda self, *a, **named: made.append(own(self, *a, **named)))
    lengths = []
    for table in (types.float64[::1, :], types.float64[:, ::1]):
        made.clear()
        with quick_numba():
            njit(exchanged).compile((table, kind, kind))
        lengths.append(len(made))
    assert lengths[1] < lengths[0] - 40
