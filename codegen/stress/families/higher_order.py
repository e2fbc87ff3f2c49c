"""Schemes of higher order: how far they are stable, what they promise on ellipses, over long times and for particles.

The cases are those of the other families, on the problems where a higher order makes a difference to the answer: the
oscillator, whose stability limits follow from the tables of the schemes; ellipses, where an order counts only once the
closest approach is resolved; a stiff spring beside a swing; a million steps; bodies and landmarks that come close.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from codegen.stress.cases import Case
from codegen.stress.families import orbits, particles, stiff
from codegen.stress.families.common import SchemeOf, of_order, promised, registered, setup

KEPLER_SCHEMES = tuple(("hamiltonian", name) for name in ("rk4", "gauss-4", "yoshida-4", "blanes-moan-6", "kahan-li-8"))
SPRING_SCHEMES = tuple(("hamiltonian", name) for name in ("gauss-4", "yoshida-4", "blanes-moan-6"))
"""An implicit one without limit, the explicit one with the lowest limit, and that with the highest."""
HORIZON_SCHEMES = tuple(("hamiltonian", name) for name in ("gauss-4", "gauss-6", "yoshida-4", "kahan-li-8"))
LANDMARK_SCHEMES = ("rk4",)
BODY_SCHEMES = ("rk4", "butcher-6", "yoshida-4", "kahan-li-8")
EPS = 2.0**-52


def cases() -> Iterator[Case]:
    """All cases of this family."""
    for scheme in of_order(3):
        yield from stiff.oscillator(scheme)
    for scheme in SPRING_SCHEMES:
        yield from stiff.spring_pendulum(scheme)
    for scheme in KEPLER_SCHEMES:
        for e in (0.5, 0.9, 0.99):
            for steps in _steps(scheme, e):
                yield orbits.ellipse(scheme, e, steps)
    for scheme in HORIZON_SCHEMES:
        yield from _horizons(scheme)
    for name in LANDMARK_SCHEMES:
        yield from particles.landmarks((None, name))
    for name in BODY_SCHEMES:
        yield from particles.bodies((None, name))
        yield _close(name)


def _steps(scheme: SchemeOf, e: float) -> tuple[int, ...]:
    """Too few steps for all but round ellipses, and steps of a tenth of the time that the closest approach takes."""
    return 300, math.ceil(3.0 * math.pi * orbits.pericentre_rate(e) / (0.1 if registered(scheme).order < 8 else 0.2))


def _horizons(scheme: SchemeOf) -> Iterator[Case]:
    substeps = max(1, len(registered(scheme).parts))  # rounding grows with them
    for steps in (1, 10, 1000, 1_000_000):
        yield Case(
            f"oscillator, {steps} steps against the scheme's closed form", "higher order", setup("oscillator", scheme),
            "accurate", "only rounding separates the steps from cos(k theta): a phase error of eps a substep, at most",
            steps, (("omega", 3.0), ("duration", steps * 0.1)), every=max(1, steps // 1000),
            reference="discrete_oscillator", bound=EPS * (20.0 + 2.0 * steps * substeps), h_omega=0.3,
        )  # fmt: skip
    if scheme in KEPLER_SCHEMES:
        yield Case(
            "Kepler, e = 0.5, a million steps", "higher order", setup("kepler", scheme), "bounded",
            "symplectic: no drift of the energy over 8000 revolutions", 1_000_000,
            (("start", orbits.start(0.5)), ("duration", 50_000.0)), every=1000, drift=0.003,
            h_omega=0.05 * math.sqrt(12.0),
        )  # fmt: skip


def _close(name: str) -> Case:
    """Two light bodies on a circle a thousandth of a unit wide, beside which unit times are an eternity."""
    scheme, gap, steps = (None, name), 1e-3, 2000
    speed = math.sqrt(2.0 / gap)
    h = 0.1 * gap / speed
    start = (((-gap / 2.0, 0.0), (gap / 2.0, 0.0)), ((0.0, -speed / 2.0), (0.0, speed / 2.0)))
    return Case(
        f"two bodies on a circle of diameter {gap:g}", "higher order", setup("gravity", scheme), "accurate",
        "close bodies are as easy as distant ones for steps in proportion", steps,
        (("start", start), ("m", (1.0, 1.0)), ("duration", h * steps)), reference="two_bodies",
        bound=1.5 * promised(scheme, 0.1, 0.1 * steps), h_omega=0.1,
    )  # fmt: skip
