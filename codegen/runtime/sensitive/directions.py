"""How the gradient of the Lagrangian, its value, and momenta change as unknowns and data move in given directions.

A direction moves all unknowns, the numbers that stand among the parameters, and the times of nodes. At a solution the
gradient has to stay zero, which tells by how much unknowns follow data; and since the equations hold, the derivative of
the Lagrangian is that of the cost (the envelope theorem).
"""

from numba import njit

from codegen.runtime.arrays import copy_part, zero_matrix, zero_vector
from codegen.runtime.stand_ins.example import (
    BODIES, COUPLING_COUNTS, COUPLING_INDICES, COUPLING_KINDS, COUPLING_ROWS, COUPLINGS, ELEMENT, END_HESSIAN_COLUMNS,
    END_HESSIAN_ROWS, EQUATIONS, HESSIAN_COLUMNS, HESSIAN_ROWS, INNER_FIRST, INNER_TIMES, NODE, ROOT, SHARED,
    START_HESSIAN_COLUMNS, START_HESSIAN_ROWS, STRIDE, TIED, coupling_term, end_gradient, end_hessian,
    interval_gradient, interval_hessian, start_gradient, start_hessian,
)  # fmt: skip
from codegen.runtime.stand_ins.example_mixed import (
    ACTING, CURVED, DATA, END_MIXED_COLUMNS, END_MIXED_ROWS, PARAMETRIC, MIXED_COLUMNS, MIXED_ROWS, START_MIXED_COLUMNS,
    START_MIXED_ROWS, VARIATIONAL, coupling_mixed, end_mixed, interval_mixed, start_mixed,
)  # fmt: skip
from codegen.runtime.unknowns.coupling import add_coupling_matrix
from codegen.runtime.unknowns.lagrangian import add_end
from codegen.runtime.unknowns.shared import read_shared, root_index
from codegen.runtime.unknowns.tied_ends import add_tied_to_shared
from codegen.runtime.unknowns.times import span


@njit(cache=True, error_model="numpy")
def change_along(
    unknowns, steps, h, nodes, parameters, vectors, rates, times, parts, products, values
):  # fmt: skip
    """Fill derivatives of the gradient, `products` (m, n), and of the Lagrangian, `values` (m,), in m directions.

    Unknowns (n,) move by `vectors` (m, n), parameters by `rates` (m, BODIES, PARAMETRIC), nodes in time by `times`
    (m, N + 1). Products are multiplied by `parts` (n,), zeros where unknowns are not solved for.
    """
    chain, size = steps * STRIDE + NODE, unknowns.size
    for d in range(len(values)):
        values[d] = 0.0
        for i in range(size):
            products[d, i] = 0.0
    local, gradient, hessian = zero_vector(ELEMENT), zero_vector(ELEMENT + SHARED), zero_vector(HESSIAN_ROWS.size)
    slopes, mixed, data = zero_vector(DATA), zero_vector(MIXED_ROWS.size), zero_vector(DATA)
    moved, part = zero_vector(ELEMENT + SHARED), zero_vector(ELEMENT + SHARED)
    for body in range(BODIES):
        own = parameters[body]
        if SHARED:
            read_shared(unknowns, body, parameters)
        for k in range(steps):
            first = body * chain + k * STRIDE
            t, length = span(nodes, k, h)
            copy_part(unknowns, first, local)
            clear_vector(slopes)
            clear_vector(mixed)
            interval_gradient(local, t, length, own, gradient)
            interval_hessian(local, t, length, own, hessian)
            interval_mixed(local, t, length, own, slopes, mixed)
            for d in range(len(values)):
                acts = read_data(own, rates[d, body], times[d, k], times[d, k + 1], t, length, data)
                moves = read_vector(vectors[d], first, ELEMENT, body, moved)
                if not (acts or moves):  # most boundary values act on end intervals alone
                    continue
                clear_vector(part)
                if moves:
                    multiply(hessian, HESSIAN_ROWS, HESSIAN_COLUMNS, moved, part)
                    values[d] += product(gradient, moved)
                if acts:
                    for j in range(MIXED_ROWS.size):
                        part[MIXED_ROWS[j]] += mixed[j] * data[MIXED_COLUMNS[j]]
                    values[d] += product(slopes, data)
                add_end(part, first, ELEMENT, body, products[d])
        add_ends(unknowns, body, steps, h, own, vectors, rates, times, products, values)
        if TIED:
            for d in range(len(values)):
                row = products[d]
                add_tied_to_shared(row, body * chain, body * chain + steps * STRIDE, body, row[size - ROOT :])
    if COUPLINGS:
        add_conditions_along(unknowns, parameters[0], vectors, rates, products, values)
    for d in range(len(values)):
        for i in range(size):
            products[d, i] = parts[i] * products[d, i] if parts[i] != 0.0 else 0.0


if VARIATIONAL:

    @njit(cache=True, error_model="numpy")
    def momenta_along(unknowns, steps, h, nodes, parameters, vector, rates, times, momenta):
        """Fill derivatives of `momenta` (BODIES, N + 1, EQUATIONS.size) in one direction, see `discrete_momenta`.

        It is `vector` (n,), `rates` (BODIES, PARAMETRIC), `times` (N + 1,).
        """
        hessian, slopes, mixed = zero_vector(HESSIAN_ROWS.size), zero_vector(DATA), zero_vector(MIXED_ROWS.size)
        moved, part, data = zero_vector(ELEMENT + SHARED), zero_vector(ELEMENT + SHARED), zero_vector(DATA)
        for body in range(BODIES):
            own = parameters[body]
            if SHARED:
                read_shared(unknowns, body, parameters)
            for k in range(steps):
                first = body * (steps * STRIDE + NODE) + k * STRIDE
                t, length = span(nodes, k, h)
                local = unknowns[first : first + ELEMENT]
                interval_hessian(local, t, length, own, hessian)
                clear_vector(slopes)
                clear_vector(mixed)
                interval_mixed(local, t, length, own, slopes, mixed)
                read_data(own, rates[body], times[k], times[k + 1], t, length, data)
                read_vector(vector, first, ELEMENT, body, moved)
                clear_vector(part)
                multiply(hessian, HESSIAN_ROWS, HESSIAN_COLUMNS, moved, part)
                for j in range(MIXED_ROWS.size):
                    part[MIXED_ROWS[j]] += mixed[j] * data[MIXED_COLUMNS[j]]
                for i in range(EQUATIONS.size):
                    momenta[body, k, i] = -part[EQUATIONS[i]]
                    momenta[body, k + 1, i] = part[STRIDE + EQUATIONS[i]]  # of the last one it remains


@njit(error_model="numpy", inline="always")
def clear_vector(vector):
    """Make all entries zero."""
    for i in range(vector.size):
        vector[i] = 0.0


@njit(error_model="numpy", inline="always")
def product(one, other):
    """The sum of products of entries."""
    total = 0.0
    for i in range(one.size):
        total += one[i] * other[i]
    return total


@njit(error_model="numpy", inline="always")
def multiply(entries, rows, columns, vector, result):
    """Add to `result` a symmetric matrix, of which `entries` are the lower triangle, times a vector."""
    for j in range(entries.size):
        row, column = rows[j], columns[j]
        result[row] += entries[j] * vector[column]
        if row != column:
            result[column] += entries[j] * vector[row]


@njit(error_model="numpy")
def read_data(parameters, rates, begin, end, t, h, data):
    """Fill `data` (DATA,) with derivatives: of parameters, of where the interval at t is, of numbers of its left node.

    Return whether an interval is concerned: boundary values that act at the ends alone are left out.
    """
    acts = False
    for i in ACTING:
        data[i] = rates[i]
        acts = acts or data[i] != 0.0
    data[PARAMETRIC] = begin
    data[PARAMETRIC + 1] = end - begin
    acts = acts or begin != 0.0 or end != 0.0
    if INNER_TIMES:
        for number in range(DATA - PARAMETRIC - 2):
            found = 0.0
            for i in range(INNER_FIRST, INNER_FIRST + INNER_TIMES):
                found += rates[i + (number + 1) * INNER_TIMES] if abs(t - parameters[i]) < 1e-6 * h else 0.0
            data[PARAMETRIC + 2 + number] = found
            acts = acts or found != 0.0
    return acts


@njit(error_model="numpy")
def read_vector(vector, first, size, body, moved):
    """Fill `moved` (size + SHARED,) with `size` entries from `first` on, then those of the body's shared unknowns.

    Return whether any is not zero.
    """
    moves = False
    for i in range(size):
        moved[i] = vector[first + i]
        moves = moves or moved[i] != 0.0
    if SHARED:
        for j in range(SHARED):
            moved[size + j] = vector[vector.size - ROOT + root_index(body, j)]
            moves = moves or moved[size + j] != 0.0
    return moves


@njit(error_model="numpy")
def add_ends(unknowns, body, steps, h, parameters, vectors, rates, times, products, values):
    """Add what the shares of start and end change; what is pinned there stands behind their data."""
    moved, part, data = zero_vector(NODE + SHARED), zero_vector(NODE + SHARED), zero_vector(DATA + NODE)
    for k in (0, steps):
        gradient, slopes, t = zero_vector(NODE + SHARED), zero_vector(DATA + NODE), k * h
        first = body * (steps * STRIDE + NODE) + k * STRIDE
        node = unknowns[first : first + NODE]
        rows, columns = (END_MIXED_ROWS, END_MIXED_COLUMNS) if k else (START_MIXED_ROWS, START_MIXED_COLUMNS)
        mixed = zero_vector(rows.size)
        if k:
            end_gradient(node, t, parameters, gradient)
            end_mixed(node, t, parameters, slopes, mixed)
        else:
            start_gradient(node, t, parameters, gradient)
            start_mixed(node, t, parameters, slopes, mixed)
        if CURVED:
            at_start, at_end = zero_vector(START_HESSIAN_ROWS.size), zero_vector(END_HESSIAN_ROWS.size)
            if k:
                end_hessian(node, t, parameters, at_end)
            else:
                start_hessian(node, t, parameters, at_start)
        for d in range(len(values)):
            for i in range(PARAMETRIC):
                data[i] = rates[d, body, i]
            data[PARAMETRIC] = times[d, k]
            read_vector(vectors[d], first, NODE, body, moved)
            copy_part(moved, 0, data[DATA:])
            clear_vector(part)
            if CURVED:  # the other one is zero
                multiply(at_start, START_HESSIAN_ROWS, START_HESSIAN_COLUMNS, moved, part)
                multiply(at_end, END_HESSIAN_ROWS, END_HESSIAN_COLUMNS, moved, part)
            for j in range(rows.size):
                part[rows[j]] += mixed[j] * data[columns[j]]
            values[d] += product(slopes, data) + product(gradient, moved)
            add_end(part, first, NODE, body, products[d])


if COUPLINGS:

    @njit(error_model="numpy")
    def add_conditions_along(unknowns, parameters, vectors, rates, products, values):
        """Add what the conditions between shared unknowns change."""
        first, multipliers, width = unknowns.size - ROOT, unknowns.size - COUPLINGS, COUPLING_INDICES.shape[1]
        matrix = zero_matrix(ROOT, ROOT)
        add_coupling_matrix(unknowns, parameters, 1.0, matrix)
        for d in range(len(values)):
            for i in range(ROOT):
                for j in range(ROOT):
                    products[d, first + i] += matrix[i, j] * vectors[d, first + j]
        read, slopes, curvatures = zero_vector(width), zero_vector(width), zero_vector(width * width)
        for i in range(COUPLING_KINDS.size):
            by_data, mixed = zero_vector(DATA), zero_matrix(width, DATA)
            for a in range(COUPLING_COUNTS[i]):
                read[a] = unknowns[first + COUPLING_INDICES[i, a]]
            term = coupling_term(COUPLING_KINDS[i], read, parameters, slopes, curvatures)
            coupling_mixed(COUPLING_KINDS[i], read, parameters, by_data, mixed)
            row = multipliers + COUPLING_ROWS[i]
            for d in range(len(values)):
                change = 0.0
                for j in range(PARAMETRIC):
                    change += by_data[j] * rates[d, 0, j]
                products[d, row] += change
                for a in range(COUPLING_COUNTS[i]):
                    index, follows = first + COUPLING_INDICES[i, a], 0.0
                    for j in range(PARAMETRIC):
                        follows += mixed[a, j] * rates[d, 0, j]
                    products[d, index] += unknowns[row] * follows
                    change += slopes[a] * vectors[d, index]
                values[d] += unknowns[row] * change + term * vectors[d, row]
