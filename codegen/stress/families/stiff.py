"""Fast oscillations: the harmonic oscillator by every scheme, a stiff spring pendulum, a chain with stiff springs."""

from __future__ import annotations

import math
from collections.abc import Iterator

from codegen.stress.cases import Case
from codegen.stress.families.common import (
    STIFF_SCHEMES,
    SchemeOf,
    of_order,
    oscillation,
    promised,
    registered,
    setup,
)
from codegen.stress.linear import limit
from codegen.stress.textbook import TEXTBOOK

EPS = 2.0**-52


def cases() -> Iterator[Case]:
    """All cases of this family."""
    for scheme in of_order(0, 2):
        yield from oscillator(scheme)
    for scheme in STIFF_SCHEMES:
        yield from spring_pendulum(scheme)
        yield from _swing(scheme)
    for scheme in STIFF_SCHEMES[2:]:
        yield from _chain(scheme)


def expectation(scheme: SchemeOf, h_omega: float, bound: float) -> tuple[str, str]:
    """What theory expects of an oscillation with a step, and why."""
    found = registered(scheme)
    if math.isfinite(bound):
        return "accurate", "the step resolves the oscillation"
    stable = limit(found)
    if not found.symplectic:
        if 0.0 < stable < h_omega:
            return "unsuitable", f"not symplectic, and stable only for h omega < {stable:.4g}"
        grows, power = "grows" if stable == 0.0 else "is damped", 2 if found.order == 1 else 6
        return "unsuitable", f"not symplectic: the energy {grows} by about (h omega)^{power} in every step"
    if h_omega < stable:
        steps = "any step" if math.isinf(stable) else f"h omega < {stable:.4g}"
        return "bounded", f"symplectic, and stable for {steps}: the energy swings, the phase is lost"
    return "unsuitable", f"stable only for h omega < {stable:.4g}"


def spurious_outcomes(scheme: SchemeOf, h_omega: float) -> tuple[str, ...]:
    """Other honest outcomes of an implicit scheme on a nonlinear problem with steps far beyond the fast motion.

    Its equations then have solutions far away, and the prediction from which Newton's method starts is (h omega)^2
    stretches away, so that one of those may be found, with an energy that tells, or none.
    """
    return ("unsuitable", "refused") if math.isinf(limit(registered(scheme))) and h_omega >= 10.0 else ()


def oscillator(scheme: SchemeOf) -> Iterator[Case]:
    """The largest stable step, and steps below and beyond it."""
    made = setup("oscillator", scheme)
    yield Case(
        "oscillator, largest stable step", "stiff", made, "accurate", "follows from the table of every scheme",
        steps=10, reference="stable_step", bound=1e-3, limit=True,
    )  # fmt: skip
    for h_omega in (0.01, 0.4, 1.9, 2.1, 10.0, 1e4):
        steps = math.ceil(10.0 / h_omega) if h_omega < 0.5 else 300
        # A step has up to 17 substeps, each with a few roundings.
        bound = promised(scheme, h_omega, h_omega * steps) + 20.0 * EPS * steps
        expect, reason = expectation(scheme, h_omega, bound)
        if h_omega >= 1e4 and expect == "bounded":
            reason += "; or refused, where places rounded at the size of h p are pulled back beyond the tolerance"
        yield Case(
            f"oscillator, h omega = {h_omega:g}", "stiff", made, expect, reason, steps,
            (("omega", 100.0), ("duration", steps * h_omega / 100.0)), reference="oscillator", bound=bound,
            drift=oscillation(scheme, h_omega), h_omega=h_omega, textbook=scheme[1] in TEXTBOOK, limit=True,
            allowed=("refused",) if h_omega >= 1e4 and expect == "bounded" else (),
        )  # fmt: skip


def spring_pendulum(scheme: SchemeOf) -> Iterator[Case]:
    """A stretch with unit energy (k s^2/2 = 1) beside the swing; and a swing alone with steps for the swing only."""
    made = setup("spring_pendulum", scheme)
    for k in (1e2, 1e6, 1e12):
        omega = math.sqrt(k)
        for h_omega, steps in ((0.01, 2000), (1.5, 2000), (3.0, 2000), (1e2, 500), (1e4, 500)):
            # Of a place of size one the stretch is but a part of 1/omega, so that its rounding counts omega times.
            bound = promised(scheme, h_omega, h_omega * steps) + EPS * omega * steps
            expect, reason = expectation(scheme, h_omega, bound)
            start = ("x", 1.0 + math.sqrt(2.0 / k)), ("y", 0.0), ("px", 0.0), ("py", 0.0)
            yield Case(
                f"spring pendulum, k = {k:.0e}, h omega = {h_omega:g}", "stiff", made, expect, reason, steps,
                (("k", k), ("duration", steps * h_omega / omega), ("start", start)), reference="by_integration" if
                math.isfinite(bound) else "", bound=bound, h_omega=h_omega, textbook=scheme[1] in TEXTBOOK, limit=True,
                drift=max(1.0, 2.0 * oscillation(scheme, h_omega)), allowed=spurious_outcomes(scheme, h_omega),
            )  # fmt: skip


def _swing(scheme: SchemeOf) -> Iterator[Case]:
    """The swing alone, without vibration, with steps a hundred times too long for the spring."""
    h, steps = 0.01, 300
    implicit = math.isinf(limit(registered(scheme)))
    yield Case(
        "spring pendulum, k = 1e+08, swing alone", "stiff", setup("spring_pendulum", scheme),
        "accurate" if implicit else "unsuitable",
        "an implicit scheme may step over a vibration that is not there; the limit is a rigid rod" if implicit else
        "stable only for steps that resolve a vibration, though it is not there",
        steps, (("k", 1e8), ("duration", h * steps)), reference="rigid_pendulum",
        bound=promised(scheme, h, h * steps) if implicit else math.nan, drift=1.0, h_omega=h * 1e4, limit=True,
        allowed=spurious_outcomes(scheme, h * 1e4),
    )  # fmt: skip


def _chain(scheme: SchemeOf) -> Iterator[Case]:
    made = setup("fput", scheme)
    for omega in (50.0, 1e4, 1e6):
        for h_omega, steps in ((0.01, 2000), (1.5, 20000), (3.0, 20000), (1e2, 5000), (1e4, 500)):
            bound = promised(scheme, h_omega, h_omega * steps)
            expect, reason = expectation(scheme, h_omega, bound)
            start = tuple((f"{name}{i}", 0.0) for name in "qp" for i in range(1, 7))
            stretch = math.sqrt(2.0) / omega
            fast = {"q1": 0.7 - stretch / 2.0, "q2": 0.7 + stretch / 2.0, "p2": math.sqrt(2.0)}
            yield Case(
                f"chain of springs, omega = {omega:g}, h omega = {h_omega:g}", "stiff", made, expect, reason, steps,
                (("omega", omega), ("duration", steps * h_omega / omega),
                 ("start", tuple((name, fast.get(name, value)) for name, value in start))),
                every=1 if steps <= 2000 else 10, reference="by_integration" if math.isfinite(bound) else "",
                bound=bound, h_omega=h_omega, textbook=steps <= 2000, limit=True,
                drift=max(1.0, 2.0 * oscillation(scheme, h_omega)), allowed=spurious_outcomes(scheme, h_omega),
            )  # fmt: skip
