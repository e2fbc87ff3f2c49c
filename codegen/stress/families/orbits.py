"""Kepler ellipses from round to needle-like, with steps that do and do not resolve the closest approach."""

from __future__ import annotations

import math
from collections.abc import Iterator

from codegen.stress.cases import Case
from codegen.stress.families.common import STIFF_SCHEMES, SchemeOf, promised, registered, setup
from codegen.stress.textbook import TEXTBOOK

KEPLER_SCHEMES = tuple(scheme for scheme in STIFF_SCHEMES if scheme[1] != "implicit-euler")


def start(e: float) -> tuple[tuple[str, float], ...]:
    """The farthest point of an ellipse of unit semi-major axis."""
    return ("x", 1.0 + e), ("y", 0.0), ("px", 0.0), ("py", math.sqrt((1.0 - e) / (1.0 + e)))


def pericentre_rate(e: float) -> float:
    """The angular velocity at the closest point, the largest frequency of the motion."""
    return math.sqrt((1.0 + e) / (1.0 - e) ** 3)


def cases() -> Iterator[Case]:
    """All cases of this family."""
    for scheme in KEPLER_SCHEMES:
        for e in (0.5, 0.9, 0.99, 0.999999):
            for steps in _steps(scheme, e):
                yield ellipse(scheme, e, steps)


def _steps(scheme: SchemeOf, e: float) -> tuple[int, ...]:
    resolved = math.ceil(2.0 * math.pi * pericentre_rate(e) / (0.02 if registered(scheme).order > 1 else 0.005))
    return (1000, resolved) if resolved <= 2_000_000 else (1000, 1_000_000)


def ellipse(scheme: SchemeOf, e: float, steps: int) -> Case:
    """One and a half revolutions, past the closest point twice, so that the end is far from it."""
    duration = 3.0 * math.pi
    h_omega = duration / steps * pericentre_rate(e)
    # The phase that counts is the fast one: half a turn or so at each of two passages.
    bound = promised(scheme, h_omega, 2.0 * math.pi)
    if registered(scheme).order > 2:
        # The kinetic energy there is 1/(1 - e) times that of a circle, and its error one of the time of return.
        bound = bound / (1.0 - e) if bound / (1.0 - e) < 0.5 else math.nan
    expect, reason = "unsuitable", "a step as long as the closest approach lasts, or longer, throws the body off"
    if not registered(scheme).symplectic and registered(scheme).order == 1:
        expect, reason = "unsuitable", "not symplectic: the body spirals outwards"
        bound = math.nan
    elif math.isfinite(bound):
        expect, reason = "accurate", "the step resolves the closest approach"
    elif registered(scheme).order > 2 and h_omega < 2.0:
        expect, reason = "bounded", "a high order may pass the closest approach in steps as long as that lasts"
    return Case(
        f"Kepler, e = {e:g}, {steps} steps", "orbits", setup("kepler", scheme), expect, reason, steps,
        (("start", start(e)), ("duration", duration)), every=max(1, steps // 2000), reference="kepler", bound=bound,
        drift=0.1 if registered(scheme).symplectic else 0.01, h_omega=h_omega,
        allowed=("unsuitable",) if expect == "bounded" else (),
        textbook=steps <= 2000 and scheme[1] in TEXTBOOK,
    )  # fmt: skip
