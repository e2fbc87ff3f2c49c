"""Codes that choose their own steps: references for particles whose ends are both given."""

from __future__ import annotations

from dataclasses import dataclass

from codegen.discretise.schemes.base import PARTICLES, Scheme, Step
from codegen.discretise.schemes.runge_kutta import RK4


@dataclass(frozen=True)
class Adaptive(Scheme):
    """A code of scipy that chooses its steps by a tolerance."""

    def step(self) -> Step:
        """That of the classical Runge-Kutta method, which serves for derivatives alone."""
        return RK4.step()


SCHEMES = {PARTICLES: (
    Adaptive(
        name="dop853", order=8, symmetric=False, symplectic=False,
        source="Hairer, Norsett and Wanner (1993), II.5 (scipy.integrate.DOP853)",
        summary="explicit Runge-Kutta method of order 8 with step-size control",
        adaptive="DOP853",
    ),
    Adaptive(
        name="lsoda", order=12, symmetric=False, symplectic=False,
        source="Petzold (1983), SIAM Journal on Scientific and Statistical Computing 4 (scipy.integrate.LSODA)",
        summary="multistep methods of Adams and backward differentiation formulas, order and step by error control",
        adaptive="LSODA",
    ),
)}  # fmt: skip
