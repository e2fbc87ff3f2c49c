"""From one step to a million."""

from __future__ import annotations

import math
from collections.abc import Iterator

from codegen.stress.cases import Case
from codegen.stress.families.common import MIDPOINT, SYMPLECTIC_EULER, VERLET, setup
from codegen.stress.families.orbits import start

EPS = 2.0**-52
HORIZON_SCHEMES = (SYMPLECTIC_EULER, MIDPOINT, VERLET)
"""Symplectic Euler, midpoint and Störmer-Verlet, whose discrete motion on the oscillator is known in closed form."""


def cases() -> Iterator[Case]:
    """All cases of this family."""
    for scheme in HORIZON_SCHEMES:
        for steps in (1, 2, 10, 1000, 30_000, 1_000_000):
            yield Case(
                f"oscillator, {steps} steps against the scheme's closed form", "horizons", setup("oscillator", scheme),
                "accurate", "only rounding separates the steps from cos(k theta): a phase error of eps a step, at most",
                steps, (("omega", 3.0), ("duration", steps * 0.1)), every=max(1, steps // 1000),
                reference="discrete_oscillator", bound=EPS * (20.0 + 2.0 * steps), h_omega=0.3, textbook=steps <= 1000,
            )  # fmt: skip
    for scheme in HORIZON_SCHEMES[1:]:
        for steps in (1, 2, 10):
            yield Case(
                f"Kepler, e = 0.5, {steps} steps", "horizons", setup("kepler", scheme), "accurate",
                "order 2 with a short step", steps, (("start", start(0.5)), ("duration", 0.05 * steps)),
                reference="kepler", bound=0.05**2 * steps / 4.0, h_omega=0.05, textbook=True,
            )  # fmt: skip
        yield Case(
            "Kepler, e = 0.5, a million steps", "horizons", setup("kepler", scheme), "bounded",
            "symplectic: no drift of the energy over 8000 revolutions", 1_000_000,
            (("start", start(0.5)), ("duration", 50_000.0)), every=1000, drift=0.05, h_omega=0.05 * math.sqrt(12.0),
        )  # fmt: skip
