"""The loops over particles and pairs: H, its derivatives and products with them, against the author's two terms.

What is right is the sum of both terms over a few particles, evaluated as it stands: its first derivatives by complex
steps, its second ones as differences of these in extended precision.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from sympy import Symbol

from codegen.errors import VerificationError
from codegen.model.pairwise import PairwiseModel
from codegen.transcribe.connect import PairwiseProgram
from codegen.verify.execution import Tape, Text
from codegen.verify.judgement import complex_numbers, step_of

_PARTICLES = 3
_SCALES = (0.6, 0.05)
"""How far particles are from the origin, and how large their momenta."""
_DIFFERENCE = 1e-7
_FIRST, _SECOND = 1e-9, 1e-7
"""Parts of an array's largest entry by which values, and second derivatives from differences, may be wrong."""
_DIRECTIONS = 2
_LOOPS = ("hamiltonian", "hamiltonian_gradient", "slope", "velocity", "hamiltonian_hessian", "hessian_products")
_MATRIX = "momentum_matrix"
Array = Any


def verify_particles(program: PairwiseProgram, text: Text) -> None:
    """Compare every loop with the author's terms; VerificationError names a value that is wrong."""
    model, generator = program.model, np.random.default_rng(5)
    exact, module = _Exact(model), text.interpreted(*_LOOPS, _MATRIX)
    for scale in _SCALES:
        size = (2, _PARTICLES, len(model.coordinates))
        state = scale * generator.uniform(-1.0, 1.0, size) / np.sqrt(size[-1])
        own = generator.uniform(0.5, 1.5, (_PARTICLES, len(model.own)))
        parameters = np.array(model.defaults) * generator.uniform(0.9, 1.1, len(model.defaults))
        with np.errstate(all="ignore"):
            for quantity, emitted, right, part in _compared(module, exact, (state, own, parameters)):
                _require_equal(quantity, np.asarray(emitted), np.asarray(right, float), part)


def _compared(
    module: dict[str, Any], exact: _Exact, given: tuple[Array, Array, Array]
) -> Iterator[tuple[str, Array, Array, float]]:
    """Name of a quantity, its emitted and its right value, and the part by which they may differ."""
    energy, gradient, hessian = exact.at(*given)
    state = given[0]

    def filled(name: str, shape: Sequence[int], *beside: Array) -> Array:
        array = np.zeros(shape)
        module[name](*given, *beside, array)
        return array

    yield "the energy H", module["hamiltonian"](*given), energy, _FIRST
    for name, right in (("hamiltonian_gradient", gradient), ("slope", gradient[0]), ("velocity", gradient[1])):
        if name in module:
            yield f"{name} of H", filled(name, right.shape), right, _FIRST
    if "hamiltonian_hessian" in module:
        yield "hamiltonian_hessian", filled("hamiltonian_hessian", hessian.shape), hessian, _SECOND
    if "hessian_products" in module:
        directions = np.random.default_rng(6).normal(size=(state.size, _DIRECTIONS))
        yield (
            "hessian_products",
            filled("hessian_products", directions.shape, directions),
            hessian.astype(float) @ directions,
            _SECOND,
        )
    if _MATRIX in module:
        size, half = state.shape[2], state.size // 2
        yield _MATRIX, filled(_MATRIX, (_PARTICLES, _PARTICLES)), hessian[half::size, half::size], _SECOND


def _require_equal(quantity: str, emitted: Array, right: Array, part: float) -> None:
    if not np.all(np.isfinite(right)):  # the terms have no value there
        return
    odd = ~(abs(emitted - right) <= part * abs(right).max(initial=0.0))
    if odd.any():
        index = tuple(int(i) for i in np.argwhere(odd)[0])
        raise VerificationError(
            f"the emitted code gives {float(emitted[index]):.8g} for {quantity}{list(index) or ''}, where "
            f"{float(right[index]):.8g} is right",
            "this is a defect of codegen, and nothing was written; please report it with the problem file",
        )


class _Exact:
    """H of a few particles, as the author wrote its terms, and its derivatives."""

    def __init__(self, model: PairwiseModel) -> None:
        self.model = model
        self.alone, self.both = Tape([model.self_term]), Tape([model.pair_term])
        self.numbers, self.step = complex_numbers(np.clongdouble), step_of(np.clongdouble)

    def at(self, state: Array, own: Array, parameters: Array) -> tuple[Array, Array, Array]:
        """H, its gradient (2, n, d) and its Hessian by the flat state."""
        size = state.size
        flat = state.reshape(-1).astype(np.clongdouble)
        # Rows: the state itself, then moved ahead and back along each of its entries; columns: complex steps.
        length = np.longdouble(_DIFFERENCE) * abs(flat).max()
        moves = length * np.concatenate([np.zeros((1, size)), np.eye(size), -np.eye(size)])
        points = (flat + moves)[:, None, :] + 1j * self.step * np.eye(size)
        states = points.reshape(*points.shape[:2], *state.shape)
        model = self.model
        common: dict[Symbol, Any] = dict(zip(model.parameters, parameters.astype(np.clongdouble), strict=True))
        values = np.zeros(states.shape[:2], np.clongdouble)
        for i in range(_PARTICLES):
            here = common | self._symbols(model.first, states, own, i)
            values = values + self.alone.evaluate(here, self.numbers)[0]
            for j in range(i):
                both = here | self._symbols(model.second, states, own, j)
                values = values + self.both.evaluate(both, self.numbers)[0]
        slopes = values.imag / self.step
        hessian = (slopes[1 : size + 1] - slopes[size + 1 :]) / (2 * length)
        return values[0, 0].real, slopes[0].reshape(state.shape), hessian

    def _symbols(self, symbols: Any, states: Array, own: Array, particle: int) -> dict[Symbol, Any]:
        moving = [states[:, :, part, particle, k] for part in range(2) for k in range(states.shape[-1])]
        values = dict(zip(symbols.moving, moving, strict=True))
        return values | dict(zip(symbols.own, own[particle].astype(np.clongdouble), strict=True))
