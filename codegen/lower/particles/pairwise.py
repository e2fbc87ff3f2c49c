"""Derivatives of a pairwise Hamiltonian -> loops over pairs, as strings.

States are arrays z of shape (2, n, d): positions z[0], momenta z[1]. Rows of second derivatives run over z in this
order, z.reshape(2 n d). Every loop visits each pair once and writes to both of its particles.
"""

from __future__ import annotations

import sympy
from sympy import Expr

from codegen.derive.pairwise import PairDerivatives
from codegen.lower.kernels import Line
from codegen.lower.particles.pair_second import hessian, hessian_products, momentum_matrix
from codegen.lower.particles.pair_writer import STATE, PairLoop, Writer
from codegen.lower.particles.particle_loops import accurate_sum
from codegen.model.pairwise import PairwiseModel


def pair_loops(model: PairwiseModel, derivatives: PairDerivatives) -> tuple[tuple[str, ...], tuple[PairLoop, ...]]:
    """The code of the scalars of single particles, and the loops for H and its derivatives."""
    writer = Writer(model, derivatives)
    singles = tuple(accurate_sum(e, model) for e in writer.singles)
    return singles, (
        _hamiltonian(writer),
        _gradient(writer),
        hessian(writer),
        hessian_products(writer),
        momentum_matrix(writer),
    )


def separable_loops(model: PairwiseModel, derivatives: PairDerivatives) -> tuple[tuple[str, ...], tuple[PairLoop, ...]]:
    """The code of the scalars of single particles, and the loops for H, H_q and H_p of a separable Hamiltonian."""
    writer = Writer(model, derivatives)
    singles = tuple(accurate_sum(e, model) for e in writer.singles)
    return singles, (_hamiltonian(writer), _part(writer, "slope", 0), _part(writer, "velocity", 1))


def _part(writer: Writer, name: str, part: int) -> PairLoop:
    """H_q (part 0) or H_p (part 1) alone."""
    model, size = writer.model, writer.dimension
    alone, pair = writer.derivatives.alone, writer.derivatives.pair
    sums = [f"by_{s}" for s in model.first.moving][part * size : (part + 1) * size]
    own = [(target, "=", as_float(value)) for target, value in zip(sums, alone.gradient[part * size :], strict=False)]
    first, second = pair.gradient[part * size :], pair.gradient[(2 + part) * size :]
    both = [(target, "+=", value) for target, value in zip(sums, first, strict=False)]
    both += [(f"rates[j, {a}]", "+=", value) for a, value in enumerate(second[:size])]
    quantity = "H_p" if part else "H_q"
    return writer.loop(
        name, f"Fill `rates`, shape (n, d), with {quantity}.", (*STATE, "rates"),
        writer.lowered(alone, own, alone.slopes),
        writer.lowered(pair, [entry for entry in both if entry[2] != 0], pair.slopes),
        head=[Line("rates[:]", "0.0")],
        after=[Line(f"rates[i, {a}]", target, operator="+=") for a, target in enumerate(sums)],
    )  # fmt: skip


def _hamiltonian(writer: Writer) -> PairLoop:
    alone, pair = writer.derivatives.alone, writer.derivatives.pair
    return writer.loop(
        "hamiltonian", "H at a state `z`, shape (2, n, d), of particles with parameters `own`, shape (n, k).", STATE,
        writer.lowered(alone, [("energy", "+=", alone.value)]),
        writer.lowered(pair, [("energy", "+=", pair.value)]),
        head=[Line("energy", "0.0")],
        results=["energy"],
    )  # fmt: skip


def _gradient(writer: Writer) -> PairLoop:
    model, size = writer.model, writer.dimension
    alone, pair = writer.derivatives.alone, writer.derivatives.pair
    sums = [f"by_{s}" for s in model.first.moving]
    own = [(target, "=", as_float(value)) for target, value in zip(sums, alone.gradient, strict=True)]
    both = [(target, "+=", value) for target, value in zip(sums, pair.gradient, strict=False)]
    both += [
        (f"gradient[{k // size}, j, {k % size}]", "+=", value) for k, value in enumerate(pair.gradient[2 * size :])
    ]
    return writer.loop(
        "hamiltonian_gradient", "Fill `gradient`, shape (2, n, d), with H_q and H_p.", (*STATE, "gradient"),
        writer.lowered(alone, own, alone.slopes),
        writer.lowered(pair, [entry for entry in both if entry[2] != 0], pair.slopes),
        head=[Line("gradient[:]", "0.0")],
        after=[Line(f"gradient[{k // size}, i, {k % size}]", name, operator="+=") for k, name in enumerate(sums)],
    )  # fmt: skip


def as_float(value: Expr) -> Expr:
    """A sum that begins with zero begins with a floating-point number."""
    return sympy.Float(0) if value == 0 else value
