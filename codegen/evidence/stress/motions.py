"""Cases of motions: stiff, orbital and chaotic motions, one step to a million steps, and extreme inputs.

All families share the setups of the package's own problems, the error bounds of schemes, and the oscillations of the
energy. The functions for these come first.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TypeAlias

from codegen.discretise import particles, schemes
from codegen.discretise.schemes.base import Scheme
from codegen.evidence.stress.cases import PROBLEMS, Case, Setup
from codegen.evidence.stress.systems import TEXTBOOK, area, limit, preserves_areas, swing

SchemeOf: TypeAlias = tuple[str | None, str]  # a method, or None for particles, and the name of a scheme

MECHANICAL: tuple[SchemeOf, ...] = tuple(
    (method, name) for method in ("hamiltonian", "variational") for name in schemes.METHODS[method]
)
"""All schemes for mechanical systems; the oscillator uses all, since its cases are cheap and have closed forms."""

EULER, IMPLICIT_EULER, SYMPLECTIC_EULER, MIDPOINT, VERLET = (
    ("hamiltonian", name)
    for name in ("explicit-euler", "implicit-euler", "symplectic-euler", "midpoint", "stormer-verlet")
)
STIFF_SCHEMES: tuple[SchemeOf, ...] = (EULER, IMPLICIT_EULER, SYMPLECTIC_EULER, MIDPOINT, VERLET)
"""The schemes for larger problems: one of each kind, since each takes seconds to compile."""


def setup(problem: str, scheme: SchemeOf | None = None) -> Setup:
    """Return the inputs of a module for a problem of this package; the default scheme is the problem's own."""
    method, name = scheme or (None, None)
    return Setup(PROBLEMS, name, method, (("system", problem),))


def registered(scheme: SchemeOf) -> Scheme:
    """Return the scheme from the registry."""
    method, name = scheme
    return schemes.find(name, method) if method else particles.particle_scheme(name, "connect")


def of_order(low: int, high: float = math.inf) -> tuple[SchemeOf, ...]:
    """Return the schemes for mechanical systems with an order from `low` to `high`, ends included."""
    return tuple(scheme for scheme in MECHANICAL if low <= registered(scheme).order <= high)


CONSTANT = {2: 4.0}  # the numbers by which bounds of schemes of an order are divided; see `promised`


def promised(scheme: SchemeOf, h_omega: float, phase: float) -> float:
    """Return the error bound of a scheme after the phase omega t, or NaN if h omega or the bound is 1/2 or more.

    Over the phase omega t, Euler's methods change amplitudes by exp(+-h omega omega t/2) or shift them by h omega/2.
    Schemes of order 2 shift phases by at most (h omega)^2/12 omega t (Hairer, Lubich and Wanner 2006, IX.1). The bound
    is two to three times these errors, which allows for nonlinear terms. The constants of schemes of higher order are
    below 0.03 on the oscillator (`codegen.evidence.stress.systems`), and the bound has the constant 1.
    """
    order = registered(scheme).order
    error = h_omega**order * (1.0 + phase) / CONSTANT.get(order, 1.0)
    return error if h_omega < 0.5 and error < 0.5 else math.nan


def oscillation(scheme: SchemeOf, h_omega: float) -> float:
    """Return a bound on the oscillator's relative energy oscillation; 0.1 if areas change, or if not stable."""
    entry = registered(scheme)
    return 1e-6 + 1.1 * swing(entry, h_omega) if preserves_areas(entry) and h_omega < limit(entry) else 0.1


EPS = 2.0**-52

# ---- Stiff motions ----


def stiff_cases() -> Iterator[Case]:
    """Yield cases of oscillations with time steps below and beyond the stability limit."""
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
        module = setup("fput", scheme)
        names = [f"{letter}{i}" for letter in "qp" for i in range(1, 7)]
        for omega in (50.0, 1e4, 1e6):
            for h_omega, steps in ((0.01, 2000), (1.5, 20000), (3.0, 20000), (1e2, 5000), (1e4, 500)):
                bound = promised(scheme, h_omega, h_omega * steps)
                expect, reason = expectation(scheme, h_omega, bound)
                stretch = math.sqrt(2.0) / omega
                fast = {"q1": 0.7 - stretch / 2.0, "q2": 0.7 + stretch / 2.0, "p2": math.sqrt(2.0)}
                yield Case(
                    f"chain of springs, omega = {omega:g}, h omega = {h_omega:g}", "stiff", module, expect, reason,
                    steps, (("omega", omega), ("duration", steps * h_omega / omega),
                     ("start", tuple((name, fast.get(name, 0.0)) for name in names))),
                    every=1 if steps <= 2000 else 10, reference="by_integration" if math.isfinite(bound) else "",
                    bound=bound, h_omega=h_omega, textbook=steps <= 2000, limit=True,
                    drift=max(1.0, 2.0 * oscillation(scheme, h_omega)), allowed=spurious_outcomes(scheme, h_omega),
                )  # fmt: skip


def expectation(scheme: SchemeOf, h_omega: float, bound: float) -> tuple[str, str]:
    """Return the outcome that theory predicts for an oscillation, and the reason; `bound` is the error bound or NaN."""
    entry = registered(scheme)
    if math.isfinite(bound):
        return "accurate", "the step resolves the oscillation"
    stable = limit(entry)
    if 0.0 < stable <= h_omega:
        return "unsuitable", f"stable only for h omega < {stable:.4g}"
    if not preserves_areas(entry):
        return "unsuitable", f"every step multiplies areas, and in time the energy, by {area(entry, h_omega):.3g}"
    kind = "symplectic" if entry.symplectic else "|R(iy)| = 1 for the stability function R"
    steps = "any step" if math.isinf(stable) else f"h omega < {stable:.4g}"
    return "bounded", f"{kind}, and stable for {steps}: the energy swings, the phase is lost"


def spurious_outcomes(scheme: SchemeOf, h_omega: float) -> tuple[str, ...]:
    """Return further honest outcomes of an implicit scheme with steps far beyond the fast motion.

    The equations of nonlinear problems then have distant solutions, and the prediction from which Newton's method
    starts is off by (h omega)^2 stretches. It may find a distant solution, whose energy shows the failure, or no
    solution.
    """
    return ("unsuitable", "refused") if math.isinf(limit(registered(scheme))) and h_omega >= 10.0 else ()


def oscillator(scheme: SchemeOf) -> Iterator[Case]:
    """Yield cases of the oscillator: the largest stable step, and steps below and beyond it."""
    module = setup("oscillator", scheme)
    yield Case(
        "oscillator, largest stable step", "stiff", module, "accurate", "follows from the table of every scheme",
        steps=10, reference="stable_step", bound=1e-3, limit=True,
    )  # fmt: skip
    for h_omega in (0.01, 0.4, 1.9, 2.1, 10.0, 1e4):
        steps = math.ceil(10.0 / h_omega) if h_omega < 0.5 else 300
        # A step has up to 17 substeps, each with a few rounding errors.
        bound = promised(scheme, h_omega, h_omega * steps) + 20.0 * EPS * steps
        expect, reason = expectation(scheme, h_omega, bound)
        if h_omega >= 1e4 and expect == "bounded":
            reason += "; or refused, where places rounded at the size of h p are pulled back beyond the tolerance"
        yield Case(
            f"oscillator, h omega = {h_omega:g}", "stiff", module, expect, reason, steps,
            (("omega", 100.0), ("duration", steps * h_omega / 100.0)), reference="oscillator", bound=bound,
            drift=oscillation(scheme, h_omega), h_omega=h_omega, textbook=scheme[1] in TEXTBOOK, limit=True,
            allowed=("refused",) if h_omega >= 1e4 and expect == "bounded" else (),
        )  # fmt: skip


def spring_pendulum(scheme: SchemeOf) -> Iterator[Case]:
    """Yield cases of a vibration with unit energy (k s^2/2 = 1 for the stretch s) together with a swing."""
    module = setup("spring_pendulum", scheme)
    for k in (1e2, 1e6, 1e12):
        omega = math.sqrt(k)
        for h_omega, steps in ((0.01, 2000), (1.5, 2000), (3.0, 2000), (1e2, 500), (1e4, 500)):
            # Positions of size one have stretches of size 1/omega, so that rounding errors are amplified by omega.
            bound = promised(scheme, h_omega, h_omega * steps) + EPS * omega * steps
            expect, reason = expectation(scheme, h_omega, bound)
            start = ("x", 1.0 + math.sqrt(2.0 / k)), ("y", 0.0), ("px", 0.0), ("py", 0.0)
            yield Case(
                f"spring pendulum, k = {k:.0e}, h omega = {h_omega:g}", "stiff", module, expect, reason, steps,
                (("k", k), ("duration", steps * h_omega / omega), ("start", start)), reference="by_integration" if
                math.isfinite(bound) else "", bound=bound, h_omega=h_omega, textbook=scheme[1] in TEXTBOOK, limit=True,
                drift=max(1.0, 2.0 * oscillation(scheme, h_omega)), allowed=spurious_outcomes(scheme, h_omega),
            )  # fmt: skip


# ---- Orbits ----

KEPLER_SCHEMES = tuple(scheme for scheme in STIFF_SCHEMES if scheme[1] != "implicit-euler")


def kepler_start(e: float) -> tuple[tuple[str, float], ...]:
    """Return the state at the farthest point of an ellipse with unit semi-major axis and eccentricity e."""
    return ("x", 1.0 + e), ("y", 0.0), ("px", 0.0), ("py", math.sqrt((1.0 - e) / (1.0 + e)))


def pericentre_rate(e: float) -> float:
    """Return the angular velocity at the closest point, which is the largest frequency of the motion."""
    return math.sqrt((1.0 + e) / (1.0 - e) ** 3)


def orbits_cases() -> Iterator[Case]:
    """Yield cases of ellipses with increasing eccentricity."""
    for scheme in KEPLER_SCHEMES:
        for e in (0.5, 0.9, 0.99, 0.999999):
            resolved = math.ceil(2.0 * math.pi * pericentre_rate(e) / (0.02 if registered(scheme).order > 1 else 0.005))
            for steps in (1000, resolved) if resolved <= 2_000_000 else (1000, 1_000_000):
                yield ellipse(scheme, e, steps)


def ellipse(scheme: SchemeOf, e: float, steps: int) -> Case:
    """Return a case of one and a half revolutions, which passes the closest point twice and ends far from it."""
    duration = 3.0 * math.pi
    h_omega = duration / steps * pericentre_rate(e)
    # The relevant phase is the fast one: about half a turn at each of two passages.
    bound = promised(scheme, h_omega, 2.0 * math.pi)
    if registered(scheme).symplectic:
        # The energy returns after each passage, and what remains is a shift of the time of the passage, which lasts
        # 1/rate. Rounding errors change the period.
        bound = 2.0 * bound / pericentre_rate(e) + EPS * steps
    elif registered(scheme).order > 2:
        # The kinetic energy there is 1/(1 - e) times the energy on a circle, and its error changes the period.
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
        (("start", kepler_start(e)), ("duration", duration)), every=max(1, steps // 2000), reference="kepler",
        bound=bound, drift=0.1 if registered(scheme).symplectic else 0.01, h_omega=h_omega,
        allowed=("unsuitable",) if expect == "bounded" else (),
        textbook=steps <= 2000 and scheme[1] in TEXTBOOK,
    )  # fmt: skip


# ---- Chaos ----

CHAIN_SCHEMES = (("variational", "midpoint"), ("variational", "trapezoidal"))
ROD_SCHEMES = (("hamiltonian", "symplectic-euler"), ("hamiltonian", "stormer-verlet"))
"""Explicit schemes, because the Newton matrix of an implicit step of six pendulums takes minutes to compile."""
RATE = 3.0  # the approximate largest angular velocity of a chain that falls from the horizontal


def chaos_cases() -> Iterator[Case]:
    """Yield cases of chains of pendulums, with extreme masses and with stiff rods."""
    for scheme in CHAIN_SCHEMES:
        module = setup("pendulum_chain", scheme)
        yield _short(module, "double pendulum", 2.0, 200)
        for duration, steps in ((100.0, 10_000), (1000.0, 100_000)):
            yield Case(
                f"double pendulum, chaotic, t = {duration:g}", "chaos", module, "bounded",
                "symplectic: errors of places grow exponentially, that of the energy does not", steps,
                (("duration", duration),), every=steps // 2000, h_omega=RATE * duration / steps,
            )  # fmt: skip
        for heavy, light in ((1e6, 1.0), (1e12, 1.0), (1.0, 1e-6), (1.0, 1e-12)):
            yield _short(module, f"double pendulum, masses {heavy:g} and {light:g}", 2.0, 400, heavy, light)
        for light in (1e4, 1e8, 1e12):
            yield Case(
                f"double pendulum, masses 1 and {light:g}", "chaos", module, "bounded",
                "the light bob between heavy bob and pivot vibrates with the root of the mass ratio",
                2000, (("light", light), ("duration", 10.0)), h_omega=10.0 / 2000 * math.sqrt(light),
                allowed=("refused",),
            )  # fmt: skip
        yield Case(
            "double pendulum, ten steps of t = 10", "chaos", module, "unsuitable",
            "a step as long as the motion's own time cannot keep the energy, or its equations have no solution near by",
            10, (("duration", 100.0),), h_omega=30.0, allowed=("refused", "bounded"),
        )  # fmt: skip
    for rods in ROD_SCHEMES:
        # Six pendulums on stiff rods. The fastest motion is their vibration, at twice the root of the stiffness.
        module = setup("rod_chain", rods)
        for k, duration, steps in ((1e2, 1.0, 2000), (1e6, 0.1, 5000)):
            h_omega = 2.0 * math.sqrt(k) * duration / steps
            bound = promised(rods, h_omega, h_omega * steps)
            yield Case(
                f"six pendulums, stiffness {k:g}, t = {duration:g}", "chaos", module,
                "accurate" if math.isfinite(bound) else "bounded", "order of the scheme, before chaos", steps,
                (("k", k), ("duration", duration)), reference="by_integration", bound=bound, h_omega=h_omega,
                textbook=True,
            )  # fmt: skip
        for k, duration, steps in ((1e4, 100.0, 200_000), (1e8, 1.0, 200_000)):
            yield Case(
                f"six pendulums, stiffness {k:g}, chaotic, t = {duration:g}", "chaos", module, "bounded",
                "symplectic, at a step that resolves the rods", steps, (("k", k), ("duration", duration)),
                every=steps // 2000, h_omega=2.0 * math.sqrt(k) * duration / steps,
            )  # fmt: skip
        yield Case(
            "six pendulums, stiffness 1e+08, 1000 steps of t = 10", "chaos", module, "unsuitable",
            "steps a hundred times too long for the rods", 1000, (("k", 1e8), ("duration", 10.0)), h_omega=200.0,
        )  # fmt: skip


def _short(module: Setup, name: str, duration: float, steps: int, heavy: float = 1.0, light: float = 1.0) -> Case:
    """Return a case that DOP853 checks before chaos prevails; errors are assumed to grow by at most exp(t)."""
    h = duration / steps
    bound = (RATE * h) ** 2 / 4.0 * (1.0 + RATE * duration) * math.exp(duration)
    return Case(
        f"{name}, t = {duration:g}", "chaos", module, "accurate", "order 2, before chaos has had its time", steps,
        (("heavy", heavy), ("light", light), ("duration", duration)), reference="chain", bound=bound, h_omega=RATE * h,
    )  # fmt: skip


# ---- Short and long horizons ----

HORIZON_SCHEMES = (SYMPLECTIC_EULER, MIDPOINT, VERLET)
"""Symplectic Euler, midpoint and Störmer-Verlet, whose discrete motion on the oscillator has a closed form."""


def horizons_cases() -> Iterator[Case]:
    """Yield cases of one step to a million steps, compared with closed forms."""
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
                "order 2 with a short step", steps, (("start", kepler_start(0.5)), ("duration", 0.05 * steps)),
                reference="kepler", bound=0.05**2 * steps / 4.0, h_omega=0.05, textbook=True,
            )  # fmt: skip
        yield long_ellipse(scheme, "horizons", drift=0.05)


def long_ellipse(scheme: SchemeOf, family: str, drift: float) -> Case:
    """Return a case of a million steps on an ellipse; `drift` is the largest relative change of energy that passes."""
    return Case(
        "Kepler, e = 0.5, a million steps", family, setup("kepler", scheme), "bounded",
        "symplectic: no drift of the energy over 8000 revolutions", 1_000_000,
        (("start", kepler_start(0.5)), ("duration", 50_000.0)), every=1000, drift=drift,
        h_omega=0.05 * math.sqrt(12.0),
    )  # fmt: skip


# ---- Extreme inputs ----

INPUT_SCHEMES = (MIDPOINT, VERLET)


def inputs_cases() -> Iterator[Case]:
    """Yield cases with numbers at the ends of the floating-point range, singular points, and invalid values."""
    for scheme in INPUT_SCHEMES:
        module = setup("oscillator", scheme)
        # A linear problem: the motion is the same in every unit of length and time.
        for amplitude in (1e-300, 1e-310, 1e-150, 1e150, 1e300):
            # Subnormal numbers have fewer digits: the spacing of numbers near 1e-310 is 5e-14 of their size.
            yield Case(
                f"oscillator, amplitude {amplitude:g}", "inputs", module, "accurate", "a linear problem has no scale",
                100, (("omega", 1.0), ("duration", 2.0), ("start", (("q", amplitude), ("p", 0.0)))),
                reference="oscillator", bound=0.02**2 * 3.0 / 4.0 + 5e-324 / amplitude * 100.0, h_omega=0.02,
            )  # fmt: skip
        for omega in (1e-150, 1e-6, 1e6, 1e150):
            yield Case(
                f"oscillator, omega = {omega:g}", "inputs", module, "accurate", "a linear problem has no scale", 100,
                (("omega", omega), ("duration", 2.0 / omega)), reference="oscillator", bound=0.02**2 * 3.0 / 4.0,
                h_omega=0.02, allowed=("refused",),
            )  # fmt: skip
        for duration in (1e-300, 5e-324):
            yield Case(
                f"oscillator, duration {duration:g}", "inputs", module, "accurate", "nothing moves in so short a time",
                1, (("omega", 1.0), ("duration", duration)), reference="oscillator", bound=1e-15, h_omega=duration,
            )  # fmt: skip
        for name, values in (
            ("omega no number", (("omega", math.nan),)),
            ("omega infinite", (("omega", math.inf),)),
            ("start no number", (("start", (("q", math.nan),)),)),
            ("start of an unknown name", (("start", (("z", 1.0),)),)),
            ("duration zero", (("duration", 0.0),)),
            ("duration negative", (("duration", -1.0),)),
            ("duration infinite", (("duration", math.inf),)),
        ):
            yield Case(f"oscillator, {name}", "inputs", module, "refused", "named before anything is computed", 100,
                       values, drift=math.nan)  # fmt: skip
        yield Case(
            "oscillator, omega = 1e300", "inputs", module, "refused", "omega^2 overflows", 100,
            (("omega", 1e300), ("duration", 1.0)), h_omega=1e298,
        )  # fmt: skip
        for steps in (0, 10**15):
            yield Case(f"oscillator, {steps:g} steps", "inputs", module, "refused", "no steps, or more than fit", steps)
        module = setup("kepler", scheme)
        rest = (("px", 0.0), ("py", 0.0))
        yield Case(
            "Kepler, start at the centre", "inputs", module, "refused", "the force is infinite", 100,
            (("start", (("x", 0.0), ("y", 0.0), *rest)), ("duration", 1.0)),
        )  # fmt: skip
        yield Case(
            "Kepler, fall into the centre", "inputs", module, "unsuitable",
            "an energy without limit within one step", 1000,
            (("start", (("x", 1.0), ("y", 0.0), *rest)), ("duration", 5.0)), h_omega=math.inf, allowed=("refused",),
        )  # fmt: skip
        for distance in (1e-150, 1e-100, 1e100, 1e150):
            yield Case(
                f"Kepler at distance {distance:g}", "inputs", module, "refused",
                "cubes of the distance leave the range of numbers; far away the body moves straight on", 100,
                (("start", (("x", distance), ("y", 0.0), *rest)), ("duration", 1.0)), allowed=("bounded", "unsuitable"),
            )  # fmt: skip
