"""What the boundary conditions do to the first and last element matrix where they are curved."""

import numpy as np
from numba import njit

from codegen.runtime.arrays import zero_vector
from codegen.runtime.kkt.elements import LEFT_NODE, LOCAL_IS_MULTIPLIER, RIGHT_NODE, TAIL, pin_ends
from codegen.runtime.stand_ins.example import (
    BODIES, ELEMENT, END_HESSIAN_COLUMNS, END_HESSIAN_ROWS, NODE, ONLY_AT_ENDS, ROOT, SCALED, SHARED,
    START_HESSIAN_COLUMNS, START_HESSIAN_ROWS, STRIDE, end_hessian, start_hessian,
)  # fmt: skip
from codegen.runtime.unknowns.shared import global_index, root_index
from codegen.runtime.optimise.scaling import KIND, MULTIPLIES

# Ones on the diagonal that intervals have for unknowns of the start alone, and that its share takes back.
START_FILLING = np.where(
    (START_HESSIAN_ROWS == START_HESSIAN_COLUMNS) & np.isin(START_HESSIAN_ROWS, ONLY_AT_ENDS), 1.0, 0.0
)
END_FILLING = np.zeros(END_HESSIAN_ROWS.size)
END_IS_MULTIPLIER = np.concatenate([LOCAL_IS_MULTIPLIER[:NODE], LOCAL_IS_MULTIPLIER[STRIDE + NODE :]])


@njit(error_model="numpy")
def apply_boundary_conditions(unknowns, k, steps, h, parameters, weight, parts, diagonal, element):
    """Add the Hessians of the boundary conditions to the first or last `element` (ROWS, WIDTH); pin what is given.

    `unknowns` and `diagonal` (N STRIDE + NODE,) are those of a body, `parts` (ELEMENT + SHARED,) as in `fill_parts`.
    """
    if k == 0:
        entries = zero_vector(START_HESSIAN_ROWS.size)
        start_hessian(unknowns[:NODE], 0.0, parameters, entries)
        add_end_hessian(entries, START_HESSIAN_ROWS, START_HESSIAN_COLUMNS, LEFT_NODE, weight, parts, element)
    if k == steps - 1:
        entries = zero_vector(END_HESSIAN_ROWS.size)
        end_hessian(unknowns[steps * STRIDE : steps * STRIDE + NODE], steps * h, parameters, entries)
        add_end_hessian(entries, END_HESSIAN_ROWS, END_HESSIAN_COLUMNS, RIGHT_NODE, weight, parts, element)
    pin_ends(k, steps, diagonal, element)


@njit(error_model="numpy")
def add_end_hessian(entries, rows, columns, first, weight, parts, element):
    """Add `entries` (m,) of an end's Hessian, at `rows` (m,) and `columns` (m,), to `element` (ROWS, WIDTH), mirrored.

    The end's node begins at row `first`; `parts` (ELEMENT + SHARED,).
    """
    for j in range(entries.size):
        value = entries[j]
        if not (END_IS_MULTIPLIER[rows[j]] and rows[j] == columns[j]):  # it makes up for the one of `IS_LACKING`
            value *= parts[end_unknown(rows[j])] * parts[end_unknown(columns[j])]
        if not (END_IS_MULTIPLIER[rows[j]] or END_IS_MULTIPLIER[columns[j]]):
            value *= weight
        row = first + rows[j] if rows[j] < NODE else TAIL + rows[j] - NODE
        column = first + columns[j] if columns[j] < NODE else TAIL + columns[j] - NODE
        element[row, column] += value
        if row != column:
            element[column, row] += value


@njit(error_model="numpy", inline="always")
def end_unknown(local):
    """The index of an end's unknown in an element: of its node, or a shared one."""
    return local if local < NODE else ELEMENT + local - NODE


if SCALED:

    @njit(error_model="numpy")
    def add_end_entries(unknowns, body, steps, h, parameters, terms, effect, curvature):
        """Add derivatives of the ends' own shares, at `unknowns` (n,), to the tables (KINDS, KINDS) of `scaling`."""
        first = body * (steps * STRIDE + NODE)
        last = first + steps * STRIDE
        entries = zero_vector(START_HESSIAN_ROWS.size)
        start_hessian(unknowns[first : first + NODE], 0.0, parameters[body], entries)
        for j in range(entries.size):
            row, column = of_interval(START_HESSIAN_ROWS[j]), of_interval(START_HESSIAN_COLUMNS[j])
            add_entry(row, column, abs(entries[j] + START_FILLING[j]), terms, effect, curvature)
        entries = zero_vector(END_HESSIAN_ROWS.size)
        end_hessian(unknowns[last : last + NODE], steps * h, parameters[body], entries)
        for j in range(entries.size):
            row, column = of_interval(END_HESSIAN_ROWS[j]), of_interval(END_HESSIAN_COLUMNS[j])
            add_entry(row, column, abs(entries[j]), terms, effect, curvature)

    @njit(error_model="numpy")
    def add_entry(row, column, value, terms, effect, curvature):
        """Add the modulus of a derivative by two unknowns, numbered as in a node, an interval and the shared ones."""
        if MULTIPLIES[column]:
            row, column = column, row
        if MULTIPLIES[column]:
            return
        kind, of = KIND[row], KIND[column]
        if MULTIPLIES[row]:
            terms[kind, of] = max(terms[kind, of], value)
            effect[kind, of] = max(effect[kind, of], value)
        else:
            curvature[kind, of] += value

    @njit(error_model="numpy")
    def of_interval(local):
        """The number of an end's unknown among those of a node, an interval and the shared ones."""
        return local if local < NODE else STRIDE + local - NODE


@njit(error_model="numpy")
def add_end_terms(unknowns, body, steps, h, parameters, sums):
    """Add the absolute terms |K| |x| of the ends' own shares to those of each row, `sums` (n,), like `unknowns`."""
    first = body * (steps * STRIDE + NODE)
    last = first + steps * STRIDE
    entries = zero_vector(START_HESSIAN_ROWS.size)
    start_hessian(unknowns[first : first + NODE], 0.0, parameters, entries)
    add_terms(unknowns, body, first, entries, START_FILLING, START_HESSIAN_ROWS, START_HESSIAN_COLUMNS, sums)
    entries = zero_vector(END_HESSIAN_ROWS.size)
    end_hessian(unknowns[last : last + NODE], steps * h, parameters, entries)
    add_terms(unknowns, body, last, entries, END_FILLING, END_HESSIAN_ROWS, END_HESSIAN_COLUMNS, sums)


@njit(error_model="numpy")
def add_terms(unknowns, body, first, entries, filling, rows, columns, sums):
    """Add the absolute terms of one end, whose node begins at the unknown `first`, to `sums` (n,).

    What intervals have added for the `filling` is no term, and is taken away.
    """
    for j in range(entries.size):
        row, column = first + rows[j], first + columns[j]
        if SHARED:
            row = global_index(rows[j], NODE, first, body, unknowns.size)
            column = global_index(columns[j], NODE, first, body, unknowns.size)
        sums[row] += (abs(entries[j] + filling[j]) - filling[j]) * abs(unknowns[column])
        if row != column:
            sums[column] += abs(entries[j] * unknowns[row])


if SCALED:

    @njit(error_model="numpy")
    def multiply_ends(unknowns, body, steps, h, parameters, vector, product):
        """Add to `product` what the ends' own second derivatives make of `vector`, both (n,) like `unknowns`."""
        first = body * (steps * STRIDE + NODE)
        last = first + steps * STRIDE
        entries = zero_vector(START_HESSIAN_ROWS.size)
        start_hessian(unknowns[first : first + NODE], 0.0, parameters, entries)
        multiply_entries(entries, START_HESSIAN_ROWS, START_HESSIAN_COLUMNS, first, body, vector, product)
        entries = zero_vector(END_HESSIAN_ROWS.size)
        end_hessian(unknowns[last : last + NODE], steps * h, parameters, entries)
        multiply_entries(entries, END_HESSIAN_ROWS, END_HESSIAN_COLUMNS, last, body, vector, product)

    @njit(error_model="numpy")
    def multiply_entries(entries, rows, columns, first, body, vector, product):
        """The same for one end, whose node begins at the unknown `first`; `vector` and `product` are (n,)."""
        for j in range(entries.size):
            row, column = first + rows[j], first + columns[j]
            if SHARED:
                row = global_index(rows[j], NODE, first, body, vector.size)
                column = global_index(columns[j], NODE, first, body, vector.size)
            product[row] += entries[j] * vector[column]
            if row != column:
                product[column] += entries[j] * vector[row]


def end_entries(grid, unknowns):
    """Entries (rows, columns, values), 1-D, that the ends add to the lower triangle of the KKT matrix."""
    chain = grid.steps * STRIDE + NODE
    rows, columns, values = [], [], []
    for body in range(BODIES):
        first, last = body * chain, (body + 1) * chain - NODE
        at_start, at_end = np.empty(START_HESSIAN_ROWS.size), np.empty(END_HESSIAN_ROWS.size)
        start_hessian(unknowns[first : first + NODE], 0.0, grid.parameters[body], at_start)
        end_hessian(unknowns[last : last + NODE], grid.steps * grid.h, grid.parameters[body], at_end)
        from_start, from_end = first + np.arange(NODE), last + np.arange(NODE)
        if SHARED:
            root = unknowns.size - ROOT + np.array([root_index(body, j) for j in range(SHARED)])
            from_start, from_end = np.concatenate([from_start, root]), np.concatenate([from_end, root])
        rows += [from_start[START_HESSIAN_ROWS], from_end[END_HESSIAN_ROWS]]
        columns += [from_start[START_HESSIAN_COLUMNS], from_end[END_HESSIAN_COLUMNS]]
        values += [at_start, at_end]
    return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)
