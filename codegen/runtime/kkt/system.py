"""The linear system of a Newton step: factor the KKT matrix of all bodies, and solve with the factors.

Linking variables couple the bodies. They are eliminated last, from the Schur complement of all other unknowns.
"""

from numba import carray, njit

from codegen.runtime.addresses import ahead
from codegen.runtime.kkt.elimination import backward, condense, eliminate_body, forward, recover_condensed
from codegen.runtime.kkt.shape import (
    COUNTS,
    END_COLUMNS,
    END_SHARED,
    END_TIED,
    ENTRIES,
    OWN,
    START_ROWS,
    START_SHARED,
    START_TIED,
    block_size,
    column_count,
    count_of,
    last_size,
    last_width,
    padded,
    place_of,
    row_count,
    row_width,
)
from codegen.runtime.kkt.stages import stage_sizes, stage_views
from codegen.runtime.kkt.symmetric import backward_once, eliminate_once, forward_once, subtract_products

SINGULAR = 1 << 40
"""The result of `solve_system` if the matrix is singular or a condensed block is not positive definite."""


@njit(error_model="numpy", fastmath={"reassoc", "contract"})
def solve_system(
    shape, is_new, bodies, steps, inverses, tables, entries, gradient, diagonal, equations, factors, orders, step,
    is_wanted,
):  # fmt: skip
    """Factor the KKT matrix if `is_new` is 1, and solve for `step` if `is_wanted` is 1.

    All bodies are factored first, then the linking variables.

    Parameters
    ----------
    shape : Shape
        Numbers of unknowns; constants in a specialised system.
    is_new : int
        1 to factor, 0 to solve with the factors of an earlier call.
    bodies, steps : int
        Numbers of bodies and of intervals.
    inverses : int
        Number of inverted condensed blocks of a body: 1 if the blocks are equal on all intervals, else `steps`.
    tables : pointer
        Index tables; see the module `shape`.
    entries : pointer
        Second derivatives, lower triangle: of intervals (bodies, steps, entries of an interval), then of the starts of
        all bodies, then of their ends. With linking variables, the matrix (root, root) of coupling conditions follows.
    gradient, diagonal, step : pointer
        Vectors (n,): the right-hand side is minus the gradient; `diagonal` is added to the diagonal of the matrix.
    equations : int
        Number of negative eigenvalues of the KKT matrix at a minimum.
    factors, orders : pointer
        Work space with the lengths from `factor_sizes`. It keeps the factors between calls.
    is_wanted : int
        1 if `step` is to be filled, else 0.

    Returns
    -------
    int
        Number of negative pivots minus `equations`, 0 at a minimum. With a positive number `step` is not filled, and
        the true number may be larger. SINGULAR if the matrix has no factors.
    """
    node, block, width, root = shape.node, block_size(shape), row_width(shape), shape.root
    rows, end, end_width, shared_width = row_count(shape), last_size(shape), last_width(shape), padded(root)
    front_rows = column_count(shape) - block
    chain, size, length = steps * shape.stride + node, steps * block + end, steps * block + node + shape.shared
    counts, of_chains = place_of(tables, COUNTS), bodies * chain
    own, entry_count = tables[counts + OWN], tables[counts + ENTRIES]
    starts, ends = count_of(tables, START_ROWS), count_of(tables, END_COLUMNS)
    # Indices at which the parts of the work space begin.
    at_right = bodies * (size * (width + 2) + inverses * shape.condensed**2 + steps * shape.condensed * width)
    at_last = at_right + bodies * length
    at_root = at_last + bodies * end_width
    at_scratch = at_root + root * (shared_width + 3) + shared_width
    root_upper = carray(ahead(factors, at_root), (root, shared_width))
    root_inverse = carray(ahead(factors, at_root + root * shared_width), (root, 2))
    root_right = carray(ahead(factors, at_root + root * (shared_width + 2)), (root,))
    shared = carray(ahead(factors, at_root + root * (shared_width + 3)), (shared_width,))
    root_order = carray(ahead(orders, bodies * (size + 1)), (root,))
    element = carray(ahead(factors, at_scratch), (rows, width))
    at_rest = at_scratch + rows * width
    rest = carray(ahead(factors, at_rest), (front_rows, padded(front_rows)))
    at_matrix = at_rest + front_rows * padded(front_rows)
    last_matrix = carray(ahead(factors, at_matrix), (end + shape.shared, end_width))
    at_front = at_matrix + (end + shape.shared) * end_width
    front, margin = carray(ahead(factors, at_front), (width,)), carray(ahead(factors, at_front + width), (width,))
    root_matrix = carray(ahead(factors, at_front + 2 * width), (root, shared_width))
    at_remainder = at_front + 2 * width + root * shared_width
    remainder_width = padded(shape.shared + shape.carried)
    remainder = carray(ahead(factors, at_remainder), (shape.shared, remainder_width))
    stage_reals = ahead(factors, at_remainder + shape.shared * remainder_width)
    stage_integers = ahead(orders, bodies * (size + 1) + root)
    carried, excess = is_new and shape.carried, 0
    if is_new:
        if root:
            for i in range(root):
                root_right[i] = -gradient[of_chains + i]
                for j in range(shared_width):
                    root_matrix[i, j] = 0.0
        after = bodies * steps * entry_count
        for body in range(bodies):
            kept, room = stage_views(shape, tables, stage_reals, stage_integers, bodies, body, steps)
            upper, inverse, order, blocks, couplings = body_factors(
                shape, factors, orders, bodies, body, steps, inverses
            )
            regular, negative, beyond = eliminate_body(
                shape, tables, carray(ahead(entries, body * steps * entry_count), (steps, entry_count)),
                carray(ahead(entries, after + body * starts), (starts,)),
                carray(ahead(entries, after + bodies * starts + body * ends), (ends,)),
                carray(ahead(gradient, body * chain), (chain,)), carray(ahead(diagonal, body * chain), (chain,)), steps,
                upper, inverse, order, blocks, couplings, kept, room, element, rest, last_matrix,
            )  # fmt: skip
            if not regular:
                return SINGULAR
            if beyond > 0:
                return beyond
            excess += negative
            if root:
                first = (body * size + steps * block) * width
                for i in range(shape.shared):
                    for j in range(shape.shared + shape.carried):
                        remainder[i, j] = last_matrix[end + i, end + j]
                rows_of_last = carray(ahead(factors, first), (end, width))
                subtract_products(
                    rows_of_last, last_matrix, end, end, shape.shared, remainder_width, remainder
                )  # fmt: skip
                for i in range(shape.shared):
                    index = root_index(own, bodies, body, i)
                    for j in range(shape.shared):
                        root_matrix[index, root_index(own, bodies, body, j)] += remainder[min(i, j), max(i, j)]
                    if shape.carried:
                        root_right[index] += remainder[i, shape.shared]
        if root:
            at_conditions = after + bodies * (starts + ends)
            for i in range(root):
                for j in range(root):
                    root_matrix[i, j] += entries[at_conditions + i * root + j]
                root_matrix[i, i] += diagonal[of_chains + i]
            negative = eliminate_once(root_matrix, root, shared_width, root_upper, root_inverse, root_order)
            if negative < 0:
                return SINGULAR
            excess += negative
        excess -= equations
    if not is_wanted or excess > 0:
        return excess
    if root:
        for i in range(root):
            shared[i] = root_right[i] if carried else -gradient[of_chains + i]
    for body in range(bodies):
        right = carray(ahead(factors, at_right + body * length), (length,))
        last = carray(ahead(factors, at_last + body * end_width), (end_width,))
        upper, inverse, order, blocks, couplings = body_factors(shape, factors, orders, bodies, body, steps, inverses)
        if carried:
            for i in range(length):
                right[i] = 0.0
            for i in range(end_width):
                last[i] = 0.0
        else:
            kept, room = stage_views(shape, tables, stage_reals, stage_integers, bodies, body, steps)
            of_body = carray(ahead(gradient, body * chain), (chain,))
            condense(shape, tables, of_body, blocks, couplings, kept, room, steps, right)
            first, behind = (steps * block, 0) if shape.backward else (0, steps * block)
            if root:
                add_tied(tables, START_TIED, START_SHARED, own, bodies, body, first, right, shared)
                add_tied(tables, END_TIED, END_SHARED, own, bodies, body, behind, right, shared)
            forward(shape, tables, upper, inverse, order, steps, right, front, margin, last)
            for i in range(shape.shared):
                shared[root_index(own, bodies, body, i)] += right[steps * block + node + i] + last[end + i]
    if root:
        for i in range(root, shared_width):
            shared[i] = 0.0
        forward_once(root_upper, root_inverse, root_order, root, shared_width, shared)
        backward_once(root_upper, root_order, root, shared_width, shared)
        for i in range(root):
            step[of_chains + i] = shared[i]
    for body in range(bodies):
        right = carray(ahead(factors, at_right + body * length), (length,))
        last = carray(ahead(factors, at_last + body * end_width), (end_width,))
        upper, _, order, blocks, couplings = body_factors(shape, factors, orders, bodies, body, steps, inverses)
        for i in range(shape.shared):
            last[end + i] = right[steps * block + node + i] = shared[root_index(own, bodies, body, i)]
        if shape.carried:
            last[end + shape.shared] = -1.0 if carried else 0.0
        backward(shape, tables, upper, order, steps, carried, last, front, margin, right)
        if root:
            first, behind = (steps * block, 0) if shape.backward else (0, steps * block)
            copy_to_tied(tables, START_TIED, START_SHARED, own, bodies, body, first, right, shared)
            copy_to_tied(tables, END_TIED, END_SHARED, own, bodies, body, behind, right, shared)
        kept, room = stage_views(shape, tables, stage_reals, stage_integers, bodies, body, steps)
        of_body = carray(ahead(gradient, body * chain), (chain,))
        step_of_body = carray(ahead(step, body * chain), (chain,))
        recover_condensed(shape, tables, of_body, blocks, couplings, kept, room, steps, right, step_of_body)
    return excess


@njit(error_model="numpy", forceinline=True)
def body_factors(shape, factors, orders, bodies, body, steps, inverses):
    """Return the factors of a body as views of the work space: `upper`, `inverse`, `order`, `inverses` and `couplings`.

    `elimination` explains these arrays.
    """
    width, size, condensed = row_width(shape), steps * block_size(shape) + last_size(shape), shape.condensed
    at_inverse = bodies * size * width
    at_inverses = at_inverse + bodies * size * 2
    at_couplings = at_inverses + bodies * inverses * condensed * condensed
    return (
        carray(ahead(factors, body * size * width), (size, width)),
        carray(ahead(factors, at_inverse + body * size * 2), (size, 2)),
        carray(ahead(orders, body * (size + 1)), (size + 1,)),
        carray(ahead(factors, at_inverses + body * inverses * condensed * condensed), (inverses, condensed, condensed)),
        carray(ahead(factors, at_couplings + body * steps * condensed * width), (steps, condensed, width)),
    )


@njit(error_model="numpy", forceinline=True)
def root_index(own, bodies, body, j):
    """Return the index among the linking variables of all bodies of linking variable j of one body.

    The first `own` variables belong to the body alone, the others are common to all bodies.
    """
    return body * own + j if j < own else (bodies - 1) * own + j


@njit(error_model="numpy")
def add_tied(tables, of_tied, of_shared, own, bodies, body, first, right, shared):
    """Add the right-hand sides of unknowns that equal linking variables to the right-hand sides `shared` of the latter.

    `of_tied` and `of_shared` are numbers of tables. The node of the unknowns begins at index `first` of `right`.
    """
    tied, to = place_of(tables, of_tied), place_of(tables, of_shared)
    for i in range(count_of(tables, of_tied)):
        shared[root_index(own, bodies, body, tables[to + i])] += right[first + tables[tied + i]]


@njit(error_model="numpy")
def copy_to_tied(tables, of_tied, of_shared, own, bodies, body, first, right, shared):
    """Copy the values of linking variables to the unknowns that equal them; arguments as in `add_tied`."""
    tied, to = place_of(tables, of_tied), place_of(tables, of_shared)
    for i in range(count_of(tables, of_tied)):
        right[first + tables[tied + i]] = shared[root_index(own, bodies, body, tables[to + i])]


def factor_sizes(shape, copied, bodies, steps, inverses):
    """Return the lengths of the work space of `solve_system`: of floating-point numbers, and of integers.

    `copied` is the number of entries of an interval in the table STAGED. `inverses` is explained in `solve_system`.
    """

    def fours(size):
        return -(-size // 4) * 4

    block, end = shape.stride - shape.condensed - 2 * shape.stages, shape.node + shape.border
    rows, front_rows = block + shape.node + shape.shared, end + shape.shared + shape.carried
    width = fours(block + fours(front_rows))
    end_width = fours(end + fours(shape.carried + shape.shared))
    size = steps * block + end
    of_body = size * (width + 2) + inverses * shape.condensed**2 + steps * shape.condensed * width
    of_body += steps * block + shape.node + shape.shared + end_width
    common = shape.root * (2 * fours(shape.root) + 3) + fours(shape.root) + rows * width + 2 * width
    common += front_rows * fours(front_rows) + (end + shape.shared) * end_width
    common += shape.shared * fours(shape.shared + shape.carried)
    reals, integers = stage_sizes(shape, copied, bodies, steps) if shape.stages else (0, 0)
    return bodies * of_body + common + reals + 8, bodies * (size + 1) + shape.root + integers + 1
