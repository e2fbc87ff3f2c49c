"""Motions: stiff, orbital, chaotic, over one step to a million, of schemes of higher order, with extreme inputs.

Schemes of higher order: how far they are stable, what they promise on ellipses, over long times and for particles. The
cases are those of the other families, on the problems where a higher order makes a difference to the answer: the
oscillator, whose stability limits follow from the tables of the schemes; ellipses, where an order counts only once the
closest approach is resolved; a stiff spring beside a swing; a million steps; bodies and landmarks that come close.

What all families share: setups of the package's own problems, promised errors, energies that oscillate.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeAlias

from codegen.discretise import schemes
from codegen.discretise.schemes import particles
from codegen.discretise.schemes.base import Scheme
from codegen.evidence.stress.cases import Case, Setup
from codegen.evidence.stress.systems import TEXTBOOK, limit, swing

PROBLEMS = Path(__file__).parent / "problems"

SchemeOf: TypeAlias = tuple[str | None, str]
"""A method, None for particles, and a scheme."""

MECHANICAL: tuple[SchemeOf, ...] = tuple(
    (method, name) for method in ("hamiltonian", "variational") for name in schemes.METHODS[method]
)
"""What is tried on the oscillator, where it is cheap and everything is known: all schemes for mechanical systems."""

EULER, IMPLICIT_EULER, SYMPLECTIC_EULER, MIDPOINT, VERLET = (
    ("hamiltonian", name)
    for name in ("explicit-euler", "implicit-euler", "symplectic-euler", "midpoint", "stormer-verlet")
)
STIFF_SCHEMES: tuple[SchemeOf, ...] = (EULER, IMPLICIT_EULER, SYMPLECTIC_EULER, MIDPOINT, VERLET)
"""Those tried on the larger problems: one of each kind, since each costs seconds of compilation."""


def setup(problem: str, scheme: SchemeOf | None = None, **arguments: Any) -> Setup:
    """A problem of this package by method and scheme (default: the problem's own)."""
    method, name = scheme or (None, None)
    return Setup(PROBLEMS / f"{problem}.py", name, method, tuple(arguments.items()))


def registered(scheme: SchemeOf) -> Scheme:
    """What the registry says of a scheme."""
    method, name = scheme
    return schemes.find(name, method) if method else particles.find(name, "connect")


def of_order(low: int, high: float = math.inf) -> tuple[SchemeOf, ...]:
    """The schemes for mechanical systems with an order between two, both included."""
    return tuple(scheme for scheme in MECHANICAL if low <= registered(scheme).order <= high)


def promised(scheme: SchemeOf, h_omega: float, phase: float) -> float:
    """The error that a scheme of order p promises after a phase omega t, where h omega < 1/2; NaN where it is useless.

    Over the phase omega t the Eulers change amplitudes by exp(+-h omega omega t/2) or shift them by h omega/2, and the
    schemes of order 2 shift phases by (h omega)^2/12 omega t at most (Hairer, Lubich and Wanner 2006, IX.1): twice and
    three times these are allowed, for the nonlinear terms. Of schemes of higher order the constants are below 0.03 on
    the oscillator (`codegen.evidence.stress.systems`), and less than one is allowed.
    """
    order = registered(scheme).order
    error = h_omega**order * (1.0 + phase) / (4.0 if order == 2 else 1.0)
    return error if h_omega < 0.5 and error < 0.5 else math.nan


def oscillation(scheme: SchemeOf, h_omega: float) -> float:
    """By how much of itself a symplectic scheme lets the energy of an oscillator swing below its stable limit."""
    found = registered(scheme)
    return 1e-6 + 1.1 * swing(found, h_omega) if found.symplectic and h_omega < limit(found) else 0.1


EPS = 2.0**-52


def stiff_cases() -> Iterator[Case]:
    """All cases of this family."""
    for scheme in of_order(0, 2):
        yield from oscillator(scheme)
    for scheme in STIFF_SCHEMES:
        yield from spring_pendulum(scheme)
        # The swing alone, without vibration, with steps a hundred times too long for the spring.
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


KEPLER_SCHEMES = tuple(scheme for scheme in STIFF_SCHEMES if scheme[1] != "implicit-euler")


def start(e: float) -> tuple[tuple[str, float], ...]:
    """The farthest point of an ellipse of unit semi-major axis."""
    return ("x", 1.0 + e), ("y", 0.0), ("px", 0.0), ("py", math.sqrt((1.0 - e) / (1.0 + e)))


def pericentre_rate(e: float) -> float:
    """The angular velocity at the closest point, the largest frequency of the motion."""
    return math.sqrt((1.0 + e) / (1.0 - e) ** 3)


def orbits_cases() -> Iterator[Case]:
    """All cases of this family."""
    for scheme in KEPLER_SCHEMES:
        for e in (0.5, 0.9, 0.99, 0.999999):
            resolved = math.ceil(2.0 * math.pi * pericentre_rate(e) / (0.02 if registered(scheme).order > 1 else 0.005))
            for steps in (1000, resolved) if resolved <= 2_000_000 else (1000, 1_000_000):
                yield ellipse(scheme, e, steps)


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


CHAIN_SCHEMES = (("variational", "midpoint"), ("variational", "trapezoidal"))
ROD_SCHEMES = (("hamiltonian", "symplectic-euler"), ("hamiltonian", "stormer-verlet"))
"""Explicit ones: the Newton matrix of an implicit step of six pendulums takes minutes to compile."""
RATE = 3.0
"""About the largest angular velocity of a chain that falls from the horizontal."""


def chaos_cases() -> Iterator[Case]:
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


HORIZON_SCHEMES = (SYMPLECTIC_EULER, MIDPOINT, VERLET)
"""Symplectic Euler, midpoint and Störmer-Verlet, whose discrete motion on the oscillator is known in closed form."""


def horizons_cases() -> Iterator[Case]:
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


INPUT_SCHEMES = (MIDPOINT, VERLET)
NAN = math.nan


def inputs_cases() -> Iterator[Case]:
    """All cases of this family."""
    for scheme in INPUT_SCHEMES:
        yield from _scaled(scheme)
        yield from _unusable(scheme)
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
