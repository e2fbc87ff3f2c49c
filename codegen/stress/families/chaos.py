"""Pendulum chains at chaotic energy, and mass ratios from 1e-12 to 1e12."""

from __future__ import annotations

import math
from collections.abc import Iterator

from codegen.stress.cases import Case, Setup
from codegen.stress.families.common import SchemeOf, promised, setup

CHAIN_SCHEMES = (("variational", "midpoint"), ("variational", "trapezoidal"))
ROD_SCHEMES = (("hamiltonian", "symplectic-euler"), ("hamiltonian", "stormer-verlet"))
"""Explicit ones: the Newton matrix of an implicit step of six pendulums takes minutes to compile."""
RATE = 3.0
"""About the largest angular velocity of a chain that falls from the horizontal."""


def cases() -> Iterator[Case]:
    """All cases of this family."""
    for scheme in CHAIN_SCHEMES:
        made = setup("pendulum_chain", scheme)
        yield _short(made, "double pendulum", 2.0, 200)
        for duration, steps in ((100.0, 10_000), (1000.0, 100_000)):
            yield Case(
                f"double pendulum, chaotic, t = {duration:g}", "chaos", made, "bounded",
                "symplectic: errors of places grow exponentially, that of the energy does not", steps,
                (("duration", duration),), every=steps // 2000, h_omega=RATE * duration / steps,
            )  # fmt: skip
        for heavy, light in ((1e6, 1.0), (1e12, 1.0), (1.0, 1e-6), (1.0, 1e-12)):
            yield _short(made, f"double pendulum, masses {heavy:g} and {light:g}", 2.0, 400, heavy, light)
        for light in (1e4, 1e8, 1e12):
            yield Case(
                f"double pendulum, masses 1 and {light:g}", "chaos", made, "bounded",
                "the light bob between heavy bob and pivot vibrates with the root of the mass ratio",
                2000, (("light", light), ("duration", 10.0)), h_omega=10.0 / 2000 * math.sqrt(light),
                allowed=("refused",),
            )  # fmt: skip
        yield Case(
            "double pendulum, ten steps of t = 10", "chaos", made, "unsuitable",
            "a step as long as the motion's own time cannot keep the energy, or its equations have no solution near by",
            10, (("duration", 100.0),), h_omega=30.0, allowed=("refused", "bounded"),
        )  # fmt: skip
    for rods in ROD_SCHEMES:
        yield from _six(rods)


def _six(scheme: SchemeOf) -> Iterator[Case]:
    """Six pendulums on stiff rods, whose vibration, of twice the root of the stiffness, is the fastest motion."""
    made = setup("rod_chain", scheme)
    for k, duration, steps in ((1e2, 1.0, 2000), (1e6, 0.1, 5000)):
        h_omega = 2.0 * math.sqrt(k) * duration / steps
        bound = promised(scheme, h_omega, h_omega * steps)
        yield Case(
            f"six pendulums, stiffness {k:g}, t = {duration:g}", "chaos", made,
            "accurate" if math.isfinite(bound) else "bounded", "order of the scheme, before chaos", steps,
            (("k", k), ("duration", duration)), reference="by_integration", bound=bound, h_omega=h_omega, textbook=True,
        )  # fmt: skip
    for k, duration, steps in ((1e4, 100.0, 200_000), (1e8, 1.0, 200_000)):
        yield Case(
            f"six pendulums, stiffness {k:g}, chaotic, t = {duration:g}", "chaos", made, "bounded",
            "symplectic, at a step that resolves the rods", steps, (("k", k), ("duration", duration)),
            every=steps // 2000, h_omega=2.0 * math.sqrt(k) * duration / steps,
        )  # fmt: skip
    yield Case(
        "six pendulums, stiffness 1e+08, 1000 steps of t = 10", "chaos", made, "unsuitable",
        "steps a hundred times too long for the rods", 1000, (("k", 1e8), ("duration", 10.0)), h_omega=200.0,
    )  # fmt: skip


def _short(made: Setup, name: str, duration: float, steps: int, heavy: float = 1.0, light: float = 1.0) -> Case:
    """Compared with DOP853 before chaos has had its time: an error grows by exp(RATE t) at most."""
    h = duration / steps
    bound = (RATE * h) ** 2 / 4.0 * (1.0 + RATE * duration) * math.exp(duration)
    return Case(
        f"{name}, t = {duration:g}", "chaos", made, "accurate", "order 2, before chaos has had its time", steps,
        (("heavy", heavy), ("light", light), ("duration", duration)), reference="chain", bound=bound, h_omega=RATE * h,
    )  # fmt: skip
