"""Numbers at the edges of double precision, and what is no number at all."""

from __future__ import annotations

import math
from collections.abc import Iterator

from codegen.stress.cases import Case
from codegen.stress.families.common import MIDPOINT, VERLET, SchemeOf, setup

INPUT_SCHEMES = (MIDPOINT, VERLET)
NAN = math.nan


def cases() -> Iterator[Case]:
    """All cases of this family."""
    for scheme in INPUT_SCHEMES:
        yield from _scaled(scheme)
        yield from _unusable(scheme)
        yield from _singular(scheme)


def _scaled(scheme: SchemeOf) -> Iterator[Case]:
    """A linear problem: whatever the unit of length and time, the motion is the same."""
    made = setup("oscillator", scheme)
    for amplitude in (1e-300, 1e-310, 1e-150, 1e150, 1e300):
        # Subnormal numbers have fewer digits: 1e-310 has 4e-15 of itself.
        yield Case(
            f"oscillator, amplitude {amplitude:g}", "inputs", made, "accurate", "a linear problem has no scale", 100,
            (("omega", 1.0), ("duration", 2.0), ("start", (("q", amplitude), ("p", 0.0)))), reference="oscillator",
            bound=0.02**2 * 3.0 / 4.0 + 5e-324 / amplitude * 100.0, h_omega=0.02,
        )  # fmt: skip
    for omega in (1e-150, 1e-6, 1e6, 1e150):
        yield Case(
            f"oscillator, omega = {omega:g}", "inputs", made, "accurate", "a linear problem has no scale", 100,
            (("omega", omega), ("duration", 2.0 / omega)), reference="oscillator", bound=0.02**2 * 3.0 / 4.0,
            h_omega=0.02, allowed=("refused",),
        )  # fmt: skip
    for duration in (1e-300, 5e-324):
        yield Case(
            f"oscillator, duration {duration:g}", "inputs", made, "accurate", "nothing moves in so short a time", 1,
            (("omega", 1.0), ("duration", duration)), reference="oscillator", bound=1e-15, h_omega=duration,
        )  # fmt: skip


def _unusable(scheme: SchemeOf) -> Iterator[Case]:
    made = setup("oscillator", scheme)
    for name, values in (
        ("omega no number", (("omega", math.nan),)),
        ("omega infinite", (("omega", math.inf),)),
        ("start no number", (("start", (("q", math.nan),)),)),
        ("start of an unknown name", (("start", (("z", 1.0),)),)),
        ("duration zero", (("duration", 0.0),)),
        ("duration negative", (("duration", -1.0),)),
        ("duration infinite", (("duration", math.inf),)),
    ):
        yield Case(
            f"oscillator, {name}",
            "inputs",
            made,
            "refused",
            "named before anything is computed",
            100,
            values,
            drift=NAN,
        )
    yield Case(
        "oscillator, omega = 1e300", "inputs", made, "refused", "omega^2 overflows", 100,
        (("omega", 1e300), ("duration", 1.0)), h_omega=1e298,
    )  # fmt: skip
    for steps in (0, 10**15):
        yield Case(f"oscillator, {steps:g} steps", "inputs", made, "refused", "no steps, or more than fit", steps)


def _singular(scheme: SchemeOf) -> Iterator[Case]:
    made = setup("kepler", scheme)
    rest = (("px", 0.0), ("py", 0.0))
    yield Case(
        "Kepler, start at the centre", "inputs", made, "refused", "the force is infinite", 100,
        (("start", (("x", 0.0), ("y", 0.0), *rest)), ("duration", 1.0)),
    )  # fmt: skip
    yield Case(
        "Kepler, fall into the centre", "inputs", made, "unsuitable",
        "an energy without limit within one step", 1000,
        (("start", (("x", 1.0), ("y", 0.0), *rest)), ("duration", 5.0)), h_omega=math.inf, allowed=("refused",),
    )  # fmt: skip
    for distance in (1e-150, 1e-100, 1e100, 1e150):
        yield Case(
            f"Kepler at distance {distance:g}", "inputs", made, "refused",
            "cubes of the distance leave the range of numbers; far away the body moves straight on", 100,
            (("start", (("x", distance), ("y", 0.0), *rest)), ("duration", 1.0)), allowed=("bounded", "unsuitable"),
        )  # fmt: skip
