"""Pendulum chains at chaotic energy, and mass ratios from 1e-12 to 1e12."""

from __future__ import annotations

import math
from collections.abc import Iterator

from codegen.stress.cases import Case
from codegen.stress.families.common import setup

CHAIN_SCHEMES = (("variational", "midpoint"), ("variational", "trapezoidal"))
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
    six = setup("pendulum_chain", CHAIN_SCHEMES[0], links=6)
    yield _short(six, "six pendulums", 1.0, 400)
    yield Case(
        "six pendulums, chaotic, t = 50", "chaos", six, "bounded", "symplectic, at a step that resolves the swings",
        25_000, (("duration", 50.0),), every=25, h_omega=50.0 / 25_000 * 10.0,
    )  # fmt: skip


def _short(made: object, name: str, duration: float, steps: int, heavy: float = 1.0, light: float = 1.0) -> Case:
    """Compared with DOP853 before chaos has had its time: an error grows by exp(RATE t) at most."""
    h = duration / steps
    bound = (RATE * h) ** 2 / 4.0 * (1.0 + RATE * duration) * math.exp(duration)
    return Case(
        f"{name}, t = {duration:g}", "chaos", made, "accurate", "order 2, before chaos has had its time", steps,  # type: ignore[arg-type]
        (("heavy", heavy), ("light", light), ("duration", duration)), reference="chain", bound=bound, h_omega=RATE * h,
    )  # fmt: skip
