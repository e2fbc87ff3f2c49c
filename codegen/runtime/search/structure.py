"""The structure of an optimal control problem: its unknowns, and the derivatives that may be nonzero.

All unknowns are in one vector of length n, which includes the multipliers. For each body the vector has node 0,
interval 0, node 1, interval 1, ..., node N. These are N stride + node unknowns. After all bodies follow the linking
variables, with the multipliers of conditions between them.
"""

from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from typing import NamedTuple

import numpy as np

from codegen.runtime.kkt.shape import Shape, packed

NO_INDICES = np.zeros(0, np.int64)
NO_MASK = np.zeros(0, bool)


def _no_indices():
    return NO_INDICES


def _no_mask():
    return NO_MASK


def last_results(method):
    """Return a decorated method that caches, for each object, its results for the last four arguments."""
    return cached_property(lambda own: lru_cache(maxsize=4)(partial(method, own)))


@dataclass(frozen=True, eq=False)
class Structure:
    """Numbers and indices of the unknowns of an optimal control problem.

    Unknowns of an interval and its two nodes have local indices: left node, interval, right node, linking variables.
    The unknowns without linking variables are an element.

    Attributes
    ----------
    node, stride : int
        Number of unknowns of a node, and of a node with the interval after it.
    condensed : int
        Number of unknowns of an interval that are eliminated before all others. They come last in the interval.
    stages : int
        Number of stage values of an interval, which are its first unknowns. The multipliers of their equations come
        next. Both are eliminated together.
    bodies : int
        Number of bodies.
    own, shared, couplings : int
        Number of linking variables that each body has for itself; number of linking variables of one body, including
        the variables of the whole problem; number of conditions between linking variables.
    phases : int
        Number of phases, 0 for a single phase.
    rows, columns : array of int
        Local rows and columns of the entries of an interval's Hessian, lower triangle.
    start_rows, start_columns, end_rows, end_columns : array of int
        The same for the Hessians of both ends, with the unknowns of the node first, then the linking variables.
    is_multiplier, shared_is_multiplier : array of bool
        Masks of the multipliers among the unknowns of a node and an interval, and among the linking variables.
    start_pinned, end_pinned : array of int
        Indices of the unknowns of the first and the last node that boundary conditions prescribe, or that equal linking
        variables.
    start_tied, end_tied, start_shared, end_shared : array of int
        Indices of the unknowns of the first and the last node that equal linking variables, and of these variables.
    only_at_ends : array of int
        Indices of the unknowns that only the first and the last node have.
    backward, bordered, constant : bool
        See `kkt.shape.Shape`.
    durations : array of int
        Indices, among the linking variables of a body, of those that are durations.
    equations : array of int
        Indices of the multipliers of the equations of motion in a node, if these equations give the momenta.
    slacks, slack_multipliers : array of int
        Local indices of the slacks of an interval, and of the multipliers of the equations that define them.
    motion_equations, motion_unknowns : array of int
        Local indices of the multipliers of the equations of a time step, and of the unknowns that these equations
        determine, if a motion follows from the start.
    inner_times, inner_first : int
        Number of inner times, and the index of the first one among the parameters.
    inner_unknowns, inner_present : array of int, array of bool
        Indices of the unknowns that only nodes at inner times have. The mask (times, unknowns) is True for those that
        the node at each inner time has.
    inner_lacks : array of int
        Local indices of the unknowns that intervals after inner times lack.
    phase_lacks, switch_lacks : array of bool
        Masks of the unknowns that the intervals of each phase lack, and that the first interval after each switch
        lacks.
    tabled : int
        Total length of all tables, whose numbers follow the parameters.
    sample, first_sample : int
        Length of the sample of one measurement, and index of the first sample in the array of parameters.
    inequalities, linear_quadratic : bool
        True if unknowns have bounds; True if one Newton step suffices.
    costless, forward : bool
        True if the cost is zero, so that any feasible motion is optimal; True if a motion follows from the start and
        the controls.
    """

    node: int
    stride: int
    condensed: int
    rows: np.ndarray
    columns: np.ndarray
    is_multiplier: np.ndarray
    start_pinned: np.ndarray
    end_pinned: np.ndarray
    only_at_ends: np.ndarray = field(default_factory=_no_indices)
    stages: int = 0
    bodies: int = 1
    own: int = 0
    shared: int = 0
    couplings: int = 0
    phases: int = 0
    backward: bool = False
    bordered: bool = False
    constant: bool = False
    inequalities: bool = False
    linear_quadratic: bool = False
    costless: bool = False
    forward: bool = False
    equations: np.ndarray = field(default_factory=_no_indices)
    durations: np.ndarray = field(default_factory=_no_indices)
    start_tied: np.ndarray = field(default_factory=_no_indices)
    start_shared: np.ndarray = field(default_factory=_no_indices)
    end_tied: np.ndarray = field(default_factory=_no_indices)
    end_shared: np.ndarray = field(default_factory=_no_indices)
    start_rows: np.ndarray = field(default_factory=_no_indices)
    start_columns: np.ndarray = field(default_factory=_no_indices)
    end_rows: np.ndarray = field(default_factory=_no_indices)
    end_columns: np.ndarray = field(default_factory=_no_indices)
    slacks: np.ndarray = field(default_factory=_no_indices)
    slack_multipliers: np.ndarray = field(default_factory=_no_indices)
    motion_equations: np.ndarray = field(default_factory=_no_indices)
    motion_unknowns: np.ndarray = field(default_factory=_no_indices)
    shared_is_multiplier: np.ndarray = field(default_factory=_no_mask)
    inner_times: int = 0
    inner_first: int = 0
    inner_unknowns: np.ndarray = field(default_factory=_no_indices)
    inner_present: np.ndarray = field(default_factory=_no_mask)
    inner_lacks: np.ndarray = field(default_factory=_no_indices)
    phase_lacks: np.ndarray = field(default_factory=_no_mask)
    switch_lacks: np.ndarray = field(default_factory=_no_mask)
    tabled: int = 0
    sample: int = 0
    first_sample: int = 0

    @cached_property
    def element(self):
        """The number of unknowns of an interval with both its nodes."""
        return self.stride + self.node

    @cached_property
    def root(self):
        """The number of linking variables of all bodies, including the multipliers of conditions between them."""
        return self.bodies * self.own + self.shared - self.own + self.couplings

    @cached_property
    def is_tied(self):
        """True if unknowns of the first or the last node equal linking variables."""
        return bool(self.start_tied.size + self.end_tied.size)

    @cached_property
    def local_is_multiplier(self):
        """The mask of multipliers among the unknowns of an interval, both its nodes, and the linking variables."""
        shared = self.shared_is_multiplier if self.shared_is_multiplier.size else np.zeros(self.shared, bool)
        return np.concatenate([self.is_multiplier, self.is_multiplier[: self.node], shared])

    @cached_property
    def first_pinned(self):
        """The indices of the prescribed unknowns of the node that is eliminated first."""
        return self.end_pinned if self.backward else self.start_pinned

    @cached_property
    def border(self):
        """The indices of the unknowns of block 0 that stay until the end of the elimination.

        A block has the unknowns of a node and of its interval, without stages and condensed unknowns.
        """
        block = self.stride - self.condensed - 2 * self.stages
        return np.setdiff1d(np.arange(block), self.first_pinned) if self.bordered else NO_INDICES

    @cached_property
    def shape(self):
        """The Shape of the linear system: the constants of the factorisation of the KKT matrix."""
        block = self.stride - self.condensed - 2 * self.stages
        # Unknowns that only the ends have are zero in inner nodes. They are left out if they come last.
        inner = block - self.only_at_ends.size
        if self.only_at_ends.min(initial=block) < inner:
            inner = block
        # The right-hand side takes part in the elimination if rows, which are padded to multiples of four, have room.
        carried = (block + self.node + self.shared) % 4 > 0 and (self.node + self.shared) % 4 > 0
        flags = self.backward, self.bordered, carried, self.constant
        return Shape(
            self.node, self.stride, self.condensed, int(inner), self.border.size, self.shared, self.root,
            *map(int, flags), self.stages, -(-self.stage_reach.size // 4) * 4, self.determined_states,
        )  # fmt: skip

    @cached_property
    def determined_states(self):
        """The number of states of a node if each is determined by an equation of the interval before it, else 0.

        Such an equation contains the state at its end alone, with a constant factor, and nothing else of the interval
        contains the state: x_k+1 = Phi(x_k, u_k) of a Runge-Kutta scheme.
        """
        if not self.backward or self.condensed or self.stride < 2 * (self.node + self.stages):
            return 0
        high, low = np.maximum(self.rows, self.columns), np.minimum(self.rows, self.columns)
        first = self.node + 2 * self.stages
        equations = np.arange(first, first + self.node)
        has_state = [(side >= self.stride) & (side < self.element) for side in (high, low)]
        of_end = has_state[0] | has_state[1]
        pairs = sorted(zip(low[of_end].tolist(), high[of_end].tolist(), strict=True))
        is_determined = pairs == list(zip(equations.tolist(), range(self.stride, self.element), strict=True))
        are_free = (
            self.is_multiplier[equations].all() and not (np.isin(high, equations) & np.isin(low, equations)).any()
        )
        return self.node if is_determined and are_free else 0

    @cached_property
    def stage_entries(self):
        """The entries of an interval's Hessian that belong to stages: four tuples (entries, rows, columns).

        The tuples are the kinds slopes, outer, curved and cross, which `kkt.shape` defines. Rows and columns of stages
        and of their equations are numbered from zero. For other unknowns, rows and columns are local indices.
        """
        node, stages = self.node, self.stages
        local = np.arange(self.element + self.shared)
        is_stage = (local >= node) & (local < node + stages)
        is_equation = (local >= node + stages) & (local < node + 2 * stages)
        high, low = np.maximum(self.rows, self.columns), np.minimum(self.rows, self.columns)
        parts = []
        for is_row, is_column, first, second in (
            (is_equation, is_stage, node + stages, node),
            (is_equation, ~is_stage & ~is_equation, node + stages, 0),
            (is_stage, is_stage, node, node),
            (~is_stage & ~is_equation, is_stage, 0, node),
        ):
            straight = is_row[high] & is_column[low]
            turned = is_row[low] & is_column[high] & ~straight
            entries = np.flatnonzero(straight | turned)
            rows = np.where(straight, high, low)[entries] - first
            columns = np.where(straight, low, high)[entries] - second
            order = np.lexsort((columns, rows))
            parts.append((entries[order], rows[order], columns[order]))
        return parts

    @cached_property
    def staged(self):
        """The indices of the entries of an interval's Hessian that belong to stages or to their equations."""
        return np.concatenate([entries for entries, _, _ in self.stage_entries])

    @cached_property
    def stage_reach(self):
        """The local indices of the unknowns, other than stages, that the equations of stages contain."""
        return np.unique(self.stage_entries[1][2])

    @cached_property
    def tables(self):
        """The index tables of the linear system in one array of integers, see `kkt.shape`."""
        node, block = self.node, self.stride - self.condensed - 2 * self.stages
        tail = block + node
        left, right = (block, 0) if self.backward else (0, block)
        # The row of each local unknown in an element matrix, or its number among condensed unknowns or stages.
        stages = np.arange(self.stages)
        index = np.concatenate(
            [
                left + np.arange(node), stages, stages, np.arange(node, block), np.arange(self.condensed),
                right + np.arange(node), tail + np.arange(self.shared),
            ]
        )  # fmt: skip
        local = np.arange(self.element + self.shared)
        is_condensed = (local >= self.stride - self.condensed) & (local < self.stride)
        kinds = is_condensed[self.rows].astype(int) + is_condensed[self.columns]
        kinds[self.staged] = -1
        swapped = is_condensed[self.columns] & ~is_condensed[self.rows]
        rows = index[np.where(swapped, self.columns, self.rows)]
        columns = index[np.where(swapped, self.rows, self.columns)]
        tables, entries = {}, np.arange(kinds.size)
        for kind, name in enumerate(("KEPT", "COUPLED", "INSIDE")):
            mask = kinds == kind
            tables |= {name: entries[mask], f"{name}_ROWS": rows[mask], f"{name}_COLUMNS": columns[mask]}
        tables["TOUCHED"] = np.unique(tables["COUPLED_COLUMNS"])
        for name, first, ends in (
            ("START", left, (self.start_rows, self.start_columns)),
            ("END", right, (self.end_rows, self.end_columns)),
        ):
            for kind, values in zip(("ROWS", "COLUMNS"), ends, strict=True):
                tables[f"{name}_{kind}"] = np.where(values < node, first + values, tail + values - node)
        multipliers = np.count_nonzero(self.is_multiplier)
        ending = np.count_nonzero(self.is_multiplier[:node]) + multipliers
        common = np.count_nonzero(self.local_is_multiplier[self.element :])
        slopes, outer, curved, cross = self.stage_entries
        crossed = np.unique(cross[1])
        return packed(
            tables
            | {
                "FIRST": self.border,
                "FIRST_PINNED": self.first_pinned,
                "LAST_PINNED": self.start_pinned if self.backward else self.end_pinned,
                "START_PINNED": self.start_pinned,
                "END_PINNED": self.end_pinned,
                "START_TIED": self.start_tied,
                "START_SHARED": self.start_shared,
                "END_TIED": self.end_tied,
                "END_SHARED": self.end_shared,
                "COUNTS": [self.own, multipliers, ending, common, self.rows.size],
                "SHAPE": self.shape,
                "STAGED": self.staged,
                "SLOPE_ROWS": slopes[1],
                "SLOPE_COLUMNS": slopes[2],
                "OUTER_ROWS": outer[1],
                "OUTER_COLUMNS": np.searchsorted(self.stage_reach, outer[2]),
                "CURVED_ROWS": curved[1],
                "CURVED_COLUMNS": curved[2],
                "CROSS_ROWS": np.searchsorted(crossed, cross[1]),
                "CROSS_COLUMNS": cross[2],
                "CROSSED": index[crossed],
                "REACH": index[self.stage_reach],
            }
        )

    @cached_property
    def counts(self):
        """Numbers that compiled functions read, in the order that `linear_system.System` states."""
        sizes = self.rows.size, self.start_rows.size, self.end_rows.size
        return np.array([self.bodies, *sizes, self.own, self.root, self.element, self.stride])

    @cached_property
    def entries(self):
        """The rows and the columns of all second derivatives of an interval and of both ends.

        Both are local indices of an element, followed by the linking variables.
        """
        sides = (self.rows, self.start_rows, self.end_rows), (self.columns, self.start_columns, self.end_columns)
        return tuple(self.in_element(*side) for side in sides)

    def in_element(self, of_interval, of_start, of_end):
        """Return local indices of an interval, of the start and of the end as one array of local indices of an element.

        In `of_start` and `of_end` the unknowns of the node come first, then the linking variables.
        """
        ends = [
            np.where(part < self.node, part + first, part - self.node + self.element)
            for first, part in ((0, of_start), (self.stride, of_end))
        ]
        return np.concatenate([of_interval, *ends]).astype(np.int64)

    @cached_property
    def without_cost(self):
        """The factors that remove the cost from second derivatives of an interval, both ends and coupling conditions.

        A factor is 0 for a derivative with respect to primal unknowns alone, otherwise 1.
        """
        few, (rows, columns), is_multiplier = self.phases or 1, self.entries, self.local_is_multiplier
        root = self.layouts(few).is_multiplier[self.size(few) - self.root :]
        is_of_multiplier = np.concatenate(
            [is_multiplier[rows] | is_multiplier[columns], (root[:, None] | root).ravel()]
        )
        return np.where(is_of_multiplier, 1.0, 0.0)

    def size(self, steps):
        """Return the number n of all unknowns for a number of intervals."""
        return self.bodies * (steps * self.stride + self.node) + self.root

    def entry_count(self, steps):
        """Return the number of second derivatives of intervals, both ends of each body, and coupling conditions."""
        of_ends = self.start_rows.size + self.end_rows.size
        return self.bodies * (steps * self.rows.size + of_ends) + self.root**2

    def root_indices(self):
        """Return the indices (bodies, shared) of the linking variables of each body.

        The indices are counted from the first of all linking variables.
        """
        bodies, variables = np.arange(self.bodies)[:, None], np.arange(self.shared)
        return np.where(variables < self.own, bodies * self.own, (self.bodies - 1) * self.own) + variables

    @last_results
    def layouts(self, steps):
        """Return the Layout for `steps` intervals."""
        s, chain, size = self, steps * self.stride + self.node, self.size(steps)
        is_multiplier, is_free = np.zeros(size, dtype=bool), np.ones(size, dtype=bool)
        chains = is_multiplier[: s.bodies * chain].reshape(s.bodies, chain)
        chains[:, : -s.node].reshape(s.bodies, steps, s.stride)[:] = s.is_multiplier
        chains[:, -s.node :] = s.is_multiplier[: s.node]
        if s.couplings:
            is_multiplier[size - s.couplings :] = True
        if s.shared_is_multiplier.any():
            first = s.bodies * (chain + s.own)
            is_multiplier[s.bodies * chain : first].reshape(s.bodies, s.own)[:] = s.shared_is_multiplier[: s.own]
            is_multiplier[first : size - s.couplings] = s.shared_is_multiplier[s.own :]
        chains = is_free[: s.bodies * chain].reshape(s.bodies, chain)
        for i in s.only_at_ends:
            chains[:, i + s.stride : -s.node : s.stride] = False
        chains[:, s.start_pinned] = False
        chains[:, chain - s.node + s.end_pinned] = False
        if s.phases:
            intervals = chains[:, : steps * s.stride].reshape(s.bodies, steps, s.stride)
            lacking = np.repeat(s.phase_lacks, steps // s.phases, axis=0)
            lacking[steps // s.phases :: steps // s.phases] = s.switch_lacks
            intervals[:, :, s.node :] &= ~lacking
        return Layout.of(is_multiplier, is_free)

    @last_results
    def inner_layouts(self, steps, numbers):
        """Return the Layout for `steps` intervals if the nodes with the given `numbers` are at inner times."""
        plain, chain = self.layouts(steps), steps * self.stride + self.node
        is_free = plain.is_free.copy()
        for first in range(0, self.bodies * chain, chain):
            nodes = first + self.stride * np.arange(steps + 1)
            for j, present in zip(self.inner_unknowns, self.inner_present.T, strict=True):
                is_free[nodes + j] = False
                is_free[nodes[np.array(numbers)[present]] + j] = True
            for j in self.inner_lacks:
                is_free[nodes[np.array(numbers)] + j] = False
        return Layout.of(plain.is_multiplier, is_free)

    @last_results
    def ties(self, steps):
        """Return pairs (k, 2) of indices: an unknown of an end node, and the linking variable that it follows.

        The unknown equals the linking variable, or it differs from it by a constant such as a full turn.
        """
        chain, pairs = steps * self.stride + self.node, []
        if self.is_tied:
            for body, indices in enumerate(self.size(steps) - self.root + self.root_indices()):
                pairs += zip(body * chain + self.start_tied, indices[self.start_shared], strict=True)
                pairs += zip((body + 1) * chain - self.node + self.end_tied, indices[self.end_shared], strict=True)
        return np.array(pairs, dtype=np.int64).reshape(-1, 2)

    @last_results
    def free_durations(self, steps):
        """Return the indices of the unknowns that are durations, of the motion or of phases."""
        return np.unique(self.size(steps) - self.root + self.root_indices()[:, self.durations]).astype(np.int64)

    @last_results
    def fillings(self, steps):
        """Return pairs (k, 2) of indices: a second derivative of a start that contains a minus one, and its row.

        Intervals put a one on the diagonal for each unknown that only the ends have. At the start, where the unknown
        exists, the second derivative of the start subtracts this one again.
        """
        chain, first = steps * self.stride + self.node, self.bodies * steps * self.rows.size
        is_one = (self.start_rows == self.start_columns) & np.isin(self.start_rows, self.only_at_ends)
        pairs = [
            (first + body * self.start_rows.size + j, body * chain + self.start_rows[j])
            for body in range(self.bodies)
            for j in np.flatnonzero(is_one)
        ]
        return np.array(pairs, dtype=np.int64).reshape(-1, 2)

    @last_results
    def kinds(self, steps):
        """Return the kind (n,) of each unknown, so that unknowns of the same meaning have the same number.

        The kind is the index in a node with the interval after it. The kinds of linking variables follow.
        """
        chain = np.tile(np.arange(steps * self.stride + self.node) % self.stride, self.bodies)
        own, common = np.tile(np.arange(self.own), self.bodies), np.arange(self.own, self.shared + self.couplings)
        return np.concatenate([chain, self.stride + own, self.stride + common])


class Layout(NamedTuple):
    """Masks and indices of the multipliers and of the free unknowns on a grid.

    Attributes
    ----------
    is_multiplier, is_free : (n,)
        Masks of the multipliers, and of the unknowns that exist and are not prescribed.
    primal, multipliers : array of int
        Indices of the free primal unknowns, and of the free multipliers.
    """

    is_multiplier: np.ndarray
    is_free: np.ndarray
    primal: np.ndarray
    multipliers: np.ndarray

    @classmethod
    def of(cls, is_multiplier, is_free):
        """Return the Layout with these masks, and make all its arrays read-only."""
        primal, multipliers = np.flatnonzero(is_free & ~is_multiplier), np.flatnonzero(is_free & is_multiplier)
        for array in (is_multiplier, is_free, primal, multipliers):
            array.flags.writeable = False
        return cls(is_multiplier, is_free, primal, multipliers)
