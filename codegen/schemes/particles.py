"""Schemes for many particles: chains of substeps, the classical Runge-Kutta method, adaptive references."""

from __future__ import annotations

import difflib
from dataclasses import dataclass

from codegen import schemes
from codegen.errors import SchemeError
from codegen.schemes.base import Scheme
from codegen.schemes.compositions import NAMES, PARTITIONED
from codegen.schemes.one_step import ONE_STEPS
from codegen.schemes.runge_kutta import OF_PARTICLES, RK4
from codegen.schemes.step import Step


@dataclass(frozen=True)
class Adaptive(Scheme):
    """A code of scipy that chooses its steps by a tolerance."""

    def step(self) -> Step:
        """That of the classical Runge-Kutta method, which serves for derivatives alone."""
        return RK4.step()


_ADAPTIVE = (
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
)  # fmt: skip

PARTICLE_SCHEMES: dict[str, Scheme] = {scheme.name: scheme for scheme in (*ONE_STEPS, *OF_PARTICLES, *_ADAPTIVE)}
"""Schemes for pairwise systems by name, over which tests run; `find` knows the compositions of higher order as well."""


def find(name: str, task: str) -> Scheme:
    """The scheme of that name; SchemeError tells which there are for the task."""
    offered = [n for n, s in PARTICLE_SCHEMES.items() if task == "connect" or not s.adaptive]
    found = PARTICLE_SCHEMES.get(name) if name in offered else None
    if found is None and _is_composition(name):
        found = schemes.find(name, "hamiltonian")
    if found is None:
        close = difflib.get_close_matches(name, offered, 1)
        hint = f"did you mean {close[0]}?" if close else f"use one of {', '.join(offered)}"
        raise SchemeError(f"there is no scheme {name!r} for particles and task {task}", hint)
    return found


def _is_composition(name: str) -> bool:
    """Whether a name is that of a composition, or <composition>-of-<base>."""
    return name in (*NAMES, *(scheme.name for scheme in PARTITIONED), "forest-ruth") or "-of-" in name
