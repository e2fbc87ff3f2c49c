"""The registry of families of stress cases, and the families of control, decay, particles and higher order.

A new family is one function and one row of FAMILIES.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from codegen.discretise.schemes import find, of_method
from codegen.discretise.schemes.base import FIRST_ORDER
from codegen.evidence.stress import motions, systems
from codegen.evidence.stress.cases import Case
from codegen.evidence.stress.motions import SchemeOf, promised, registered, setup

# ---- Optimal control ----

NAN = math.nan
REFUSED = ("refused",)


def control_cases() -> Iterator[Case]:
    """Yield cases: long horizons, boundary layers, extreme units, tiny durations, large turns, poor initial guesses."""
    # Hypersensitive: the state decays and grows by exp(sqrt(2) t) at the two ends, and is nearly zero in between.
    rate = math.sqrt(2.0)
    for T, steps in ((1e-6, 10), (1.0, 1), (1.0, 20), (100.0, 1000), (1000.0, 10_000), (10_000.0, 100_000)):
        yield _regulator(
            f"hypersensitive, T = {T:g}, {steps} steps", "the layers are resolved, however long the rest", steps, rate,
            T=T,
        )  # fmt: skip
    for T in (1000.0, 10_000.0):
        yield _regulator(
            f"hypersensitive, T = {T:g}, 100 steps",
            "steps longer than the layers: midpoint keeps the solution of the algebraic Riccati equation, so that the "
            "cost is right at any step, though the path in the layers is not", 100, rate, T=T,
        )  # fmt: skip
    for eps, steps in ((1e-2, 1000), (1e-3, 10_000), (1e-4, 100_000)):
        yield _regulator(
            f"boundary layers of width {eps:g}, {steps} steps", "the layers are resolved", steps, 1.0 / eps, a=0.0,
            eps=eps, T=1.0,
        )  # fmt: skip
    for eps in (1e-3, 1e-6, 1e-9):
        yield _regulator(
            f"boundary layers of width {eps:g}, 100 steps",
            "layers inside one step: the doubled grid must show it, unless the cost is right at any step as above",
            100, 1.0 / eps, a=0.0, eps=eps, T=1.0,
        )  # fmt: skip
    module = setup("cubic_regulator")
    for T in (10.0, 100.0, 1000.0, 10_000.0):
        steps = round(20 * T)
        yield Case(
            f"cubic hypersensitive, T = {T:g}, {steps} steps", "control", module, "accurate",
            "the fastest rate, 3 x^2 = 6.75 at the end, times the step is 0.34; order 2", steps, (("T", T),),
            reference="cubic_regulator", bound=(6.75 / 20.0) ** 2 / 4.0, drift=NAN, h_omega=6.75 / 20.0,
        )  # fmt: skip
    for noise in (0.1, 1.0, 10.0):
        yield Case(
            f"cubic hypersensitive, T = 100, guess with noise {noise:g}", "control", module, "accurate",
            "the same optimum, or an honest failure", 2000, (("T", 100.0),), noise=noise, reference="cubic_regulator",
            bound=(6.75 / 20.0) ** 2 / 4.0, drift=NAN, h_omega=6.75 / 20.0, allowed=REFUSED,
        )  # fmt: skip
    for begin in (1e3, 1e6, 1e12):
        yield Case(
            f"cubic hypersensitive from x = {begin:g}", "control", module, "refused",
            "x^3 decays within 1/x^2 of time: no grid resolves it, and Newton's method may or may not find the grid's "
            "own solution", 200, (("T", 10.0), ("begin", begin)), drift=NAN, h_omega=3.0 * begin**2 / 20.0,
            allowed=("bounded",),
        )  # fmt: skip
    # The transfer in other units has the same cost, times the unit of cost; see docs/guide/limits.md for scaling.
    module = setup("transfer")
    for name in ("m", "GM", "r0"):
        for exponent in (-24, -12, -6, 6, 12, 24):
            factor = 10.0**exponent
            values = (("r0", factor), ("r1", 1.2 * factor)) if name == "r0" else ((name, factor),)
            yield Case(
                f"orbital transfer, {name} times {factor:.0e}", "control", module, "accurate",
                "scaling factors are measured: the same motion in all units", 50, values, reference="other_units",
                bound=1e-9, drift=NAN,
            )  # fmt: skip
    module = setup("arm")
    for T in (1e-9, 1e-6, 1e-3, 1.0):
        yield Case(
            f"arm, nothing to do within T = {T:g}", "control", module, "accurate", "start and end are the same rest",
            50, (("goal", 0.0), ("T", T)), reference="short_turn", bound=1e-16, drift=NAN,
        )  # fmt: skip
    for T in (1e-9, 1e-6, 1e-3):
        yield Case(
            f"arm, one radian within T = {T:g}", "control", module, "accurate",
            "gravity has no time to act: it adds a part of T^2 to torques that go with T^-2", 50, (("T", T),),
            reference="short_turn", bound=1e-9 + T**2, drift=NAN,
        )  # fmt: skip
    for turns in (10, 1000, 10**6):
        yield Case(
            f"arm, {turns} turns within T = 1", "control", module, "accurate",
            "gravity averages out over many turns; steps of thousands of turns sample it at random", 50,
            (("goal", 2.0 * math.pi * turns),), reference="short_turn", bound=max(1e-5, 0.1 / turns), drift=NAN,
        )  # fmt: skip
    yield Case(
        "arm, rest upright for T = 1", "control", module, "accurate",
        "an unstable rest at both ends: no torque is needed", 50, (("begin", math.pi), ("goal", math.pi)),
        reference="at_rest", bound=1e-12, drift=NAN,
    )  # fmt: skip
    for driver in ("slsqp", "trust-constr", "fsolve"):
        yield Case(
            f"arm, one radian within T = 0.001, by {driver}", "control", module, "accurate",
            "scipy's optimisers on the same equations, scaled", 10, (("T", 1e-3),), driver=driver,
            reference="short_turn", bound=1e-6, drift=NAN, allowed=REFUSED,
        )  # fmt: skip
    module = setup("walled_cart")
    for wall, steps in ((1.0 / 9.0, 60), (1e-2, 600), (1e-3, 6000)):
        yield Case(
            f"cart, wall at {wall:.3g}, {steps} steps", "control", module, "accurate",
            "the arcs before and after the wall last 3 times its distance, and are resolved", steps, (("wall", wall),),
            reference="walled_cart", bound=(1.0 / (3.0 * wall * steps)) ** 2 * 4.0, drift=NAN, allowed=REFUSED,
        )  # fmt: skip
    for wall in (1e-3, 1e-6, 1e-12):
        yield Case(
            f"cart, wall at {wall:g}, 60 steps", "control", module, "unsuitable",
            "all happens within one step: the doubled grid must show it, or the solver refuses", 60, (("wall", wall),),
            doublings=1, reference="walled_cart", bound=0.02, drift=NAN, allowed=REFUSED,
        )  # fmt: skip
    yield Case(
        "cart, wall behind the start", "control", module, "refused", "the start violates the bound", 60,
        (("wall", -0.1),), drift=NAN,
    )  # fmt: skip


def _regulator(name: str, reason: str, steps: int, rate: float, **values: float) -> Case:
    """Return a regulator case with decay `rate`; at small h, midpoint has a relative cost error of (h rate)^2/4."""
    h_rate = rate * values["T"] / steps
    resolved = h_rate < 0.5
    return Case(
        name, "control", setup("linear_regulator"), "accurate" if resolved else "unsuitable", reason, steps,
        tuple(values.items()), doublings=1, reference="regulator", bound=h_rate**2 / 4.0 if resolved else 0.02,
        drift=NAN, h_omega=h_rate, allowed=() if resolved else ("accurate",),
    )  # fmt: skip


# ---- Dissipation ----

COMPARED = ("implicit-euler", "radau-5", "sdirk-4")  # L-stable schemes for problems that take longer to compile
BOUNDS = {
    "robertson": (400, 3e-3, 3e-9, 3e-7),
    "van_der_pol": (100, 3e-3, 1e-7, 1e-6),
    "hires": (2000, 0.01, 1e-7, 1e-5),
    "actuator": (200, 0.2, 1e-7, 1e-6),
    "contact": (4000, 5e-3, 3e-9, 1e-7),
}
"""The problems' own steps, and the largest errors of COMPARED there: up to four times the errors at first."""


def dissipative_cases() -> Iterator[Case]:
    """Yield cases: Prothero and Robinson's problem by every scheme, and reactions, an actuator and a contact."""
    for scheme in of_method(FIRST_ORDER):
        module = setup("prothero_robinson", (None, scheme.name))
        factor = abs(systems.stability_function(scheme, -1e4))
        kind = (
            "L-stable"
            if factor < 1e-3
            else "A-stable without damping"
            if factor < 1.0 + 1e-6
            else "unstable at this step"
        )
        yield Case(
            "fast decay, h lambda = -1e4, ten steps", "dissipative", module, "accurate",
            f"{kind}: a step multiplies a deviation by |R| = {factor:.3g}, as the table says", 10,
            (("rate", -1e5), ("duration", 1.0), ("start", (("y", 2.0),))), reference="by_table", bound=1e-9,
            h_omega=1e4,
        )  # fmt: skip
        for rate in (1.0, 1e3, 1e6):
            motions_by_table = [systems.followed(scheme, -rate, n, 1.0) for n in (20, 40)]
            errors = [float(np.abs(y - np.cos(np.linspace(0.0, 1.0, y.size))).max()) for y in motions_by_table]
            if not errors[0] < 0.5:
                continue
            order = math.log2(errors[0] / errors[1]) if errors[1] > 1e-14 else math.nan
            reduced = f"order {order:.2g} of {scheme.order}" if order < 90 else "rounding errors only"
            yield Case(
                f"slow motion with a fast decay, lambda = -{rate:g}", "dissipative", module, "accurate",
                f"by the table: {reduced}", 20, (("rate", -rate), ("duration", 1.0)), reference="slow_motion",
                bound=1.01 * errors[0] + 1e-12, h_omega=rate / 20.0,
            )  # fmt: skip
    for problem, (steps, *bounds) in BOUNDS.items():
        for name, bound in zip(COMPARED, bounds, strict=True):
            yield Case(
                problem.replace("_", " "), "dissipative", setup(problem, (None, name)), "accurate",
                f"L-stable, order {find(name, FIRST_ORDER).order}", steps, reference="by_radau", bound=bound,
            )  # fmt: skip


# ---- Particles ----

CONNECT_SCHEMES = ("midpoint", "explicit-euler")
PAIR_SCHEMES = ("stormer-verlet", "symplectic-euler")

Rows = tuple[tuple[float, ...], ...]


def particle_cases() -> Iterator[Case]:
    """Yield cases: landmarks close together or to the boundary, large turns, short durations, unequal masses."""
    for name in CONNECT_SCHEMES:
        yield from landmarks((None, name))
    for name in PAIR_SCHEMES:
        yield from bodies((None, name))


def turned(count: int, radius: float, angle: float) -> Rows:
    """Return rows of start and target for `count` points on a circle that turn by `angle`."""
    angles = [2.0 * math.pi * i / count for i in range(count)]
    return tuple(
        (radius * math.cos(a), radius * math.sin(a), radius * math.cos(a + angle), radius * math.sin(a + angle))
        for a in angles
    )


def pair(distance: float, stretch: float) -> Rows:
    """Return rows of start and target for two points, which move by (0.3, 0.1); `stretch` scales their distance."""
    half = distance / 2.0
    return ((-half, 0.0, 0.3 - stretch * half, 0.1), (half, 0.0, 0.3 + stretch * half, 0.1))


def landmarks(scheme: SchemeOf) -> Iterator[Case]:
    """Yield cases of one, two and six landmarks in the unit disc."""
    module = setup("landmarks", scheme)
    steps, order = 20, registered(scheme).order

    def case(name: str, expect: str, reason: str, points: Rows, reference: str = "", bound: float = NAN,
             allowed: tuple[str, ...] = (), number: int = steps, **more: float) -> Case:  # fmt: skip
        return Case(
            f"landmarks, {name}", "particles", module, expect, reason, number, tuple(more.items()), points=points,
            reference=reference, bound=bound, drift=1.0, allowed=allowed,
        )  # fmt: skip

    for far in (0.5, 0.9, 0.99):
        length = 2.0 * math.sqrt(2.0) * math.atanh(far)
        bound = (length / 40.0) ** order * (2.0 if order == 1 else 1.0)
        long = far > 0.9 and order > 2
        yield case(
            f"one across the disc from -{far:g} to {far:g}", "accurate", "a hyperbolic line, known in closed form" +
            ("; or steps longer than the distance from the boundary, where no order counts" if long else ""),
            ((-far, 0.0, far, 0.0),), "single_landmark", bound, ("refused", "unsuitable") if long else ("refused",), 40,
        )  # fmt: skip
    for gap in (1e-3, 1e-6, 1e-9):
        yield case(
            f"one along the boundary at 1 - {gap:g}", "accurate",
            "the way is one unit of hyperbolic length; order of the scheme",
            ((1.0 - gap, 0.0, (1.0 - gap) * math.cos(gap), (1.0 - gap) * math.sin(gap)),), "single_landmark",
            (2.0 / steps) ** order, ("refused",),
        )  # fmt: skip
    for distance in (1e-2, 1e-6, 1e-12):
        yield case(
            f"two at distance {distance:g} that stay together", "accurate", "their relative motion is small",
            pair(distance, 1.0), "reintegrated", 2.0 / steps**order, ("refused",),
        )  # fmt: skip
    for distance in (1e-2, 1e-6):
        yield case(
            f"two at distance {distance:g} that part to 10 times as far", "refused",
            "momenta of close neighbours that part grow without limit; or, the discrete equations have a solution",
            pair(distance, 10.0), "", NAN, ("bounded",),
        )  # fmt: skip
    yield case("two at the same place", "refused", "no map separates them",
               ((0.1, 0.0, 0.2, 0.0), (0.1, 0.0, -0.2, 0.0)))  # fmt: skip
    yield case("two with the same target", "refused", "no map joins them",
               ((0.1, 0.0, 0.2, 0.0), (-0.1, 0.0, 0.2, 0.0)))  # fmt: skip
    yield case("one on the boundary", "refused", "the boundary does not move", ((1.0, 0.0, 0.5, 0.0),))
    yield case("one that is no number", "refused", "not a finite number", ((math.nan, 0.0, 0.5, 0.0),))
    yield case("six that stay", "accurate", "nothing is to be done", turned(6, 0.5, 0.0), "at_rest", 1e-12)
    for degrees in (45, 90, 170):
        angle = math.radians(degrees)
        bound = (angle / steps) ** order * (1.0 if order == 2 else 2.0)
        yield case(
            f"six turned by {degrees} degrees", "accurate", "a large turn, order of the scheme",
            turned(6, 0.5, angle), "reintegrated", bound, ("refused",),
        )  # fmt: skip
    for duration in (1e-6, 1e6):
        yield case(
            f"six turned by 45 degrees within {duration:g}", "accurate", "momenta go with the inverse of the time",
            turned(6, 0.5, math.pi / 4.0), "reintegrated", 2.0 * (math.pi / 4.0 / steps) ** order, ("refused",),
            duration=duration,
        )  # fmt: skip


def bodies(scheme: SchemeOf) -> Iterator[Case]:
    """Yield cases of two bodies that circle each other at unit distance, or fall into each other."""
    module = setup("gravity", scheme)
    h, steps = (0.01, 2000) if registered(scheme).order < 4 else (0.1, 200)
    for ratio in (1.0, 1e-6, 1e-12):
        speed = math.sqrt(1.0 + ratio)
        near, far = ratio / (1.0 + ratio), 1.0 / (1.0 + ratio)
        momentum = ratio * speed * far
        yield Case(
            f"two bodies, mass ratio {ratio:g}", "particles", module, "accurate",
            "a circle, order of the scheme; along it, three halves of an error of the semi-major axis add up", steps,
            (("start", (((-near, 0.0), (far, 0.0)), ((0.0, -momentum), (0.0, momentum)))), ("m", (1.0, ratio)),
             ("duration", h * steps)),
            reference="two_bodies", bound=1.5 * promised(scheme, h * speed, h * steps * speed), h_omega=h * speed,
        )  # fmt: skip
    for distance in (1e-3, 1e-9):
        yield Case(
            f"two bodies at rest at distance {distance:g}", "particles", module, "unsuitable",
            "they fall into each other within a step: energy appears from nowhere", steps,
            (("start", (((0.0, 0.0), (distance, 0.0)), ((0.0, 0.0), (0.0, 0.0)))), ("m", (1.0, 1.0)),
             ("duration", h * steps)),
            h_omega=h * distance**-1.5, allowed=("refused",),
        )  # fmt: skip
    yield Case(
        "two bodies at the same place", "particles", module, "refused", "the force is infinite", steps,
        (("start", (((0.0, 0.0), (0.0, 0.0)), ((0.0, 0.0), (0.0, 0.0)))), ("m", (1.0, 1.0)), ("duration", 1.0)),
        h_omega=NAN,
    )  # fmt: skip


# ---- Schemes of higher order ----

HIGHER_KEPLER_SCHEMES = tuple(
    ("hamiltonian", name) for name in ("rk4", "gauss-4", "yoshida-4", "blanes-moan-6", "kahan-li-8")
)
SPRING_SCHEMES = tuple(("hamiltonian", name) for name in ("gauss-4", "yoshida-4", "blanes-moan-6"))
"""An implicit scheme without a stability limit, and the explicit schemes with the lowest and the highest limit."""
LONG_SCHEMES = tuple(("hamiltonian", name) for name in ("gauss-4", "gauss-6", "yoshida-4", "kahan-li-8"))
LANDMARK_SCHEMES = ("rk4",)
BODY_SCHEMES = ("rk4", "butcher-6", "yoshida-4", "kahan-li-8")


def higher_order_cases() -> Iterator[Case]:
    """Yield cases in which a scheme of higher order changes the result.

    The stability limits of the oscillator follow from the coefficients of the schemes. On ellipses, an order shows only
    if the time step resolves the closest approach. Further cases are a stiff spring with a swing, a million steps, and
    bodies and landmarks that come close to each other.
    """
    for scheme in motions.of_order(3):
        yield from motions.oscillator(scheme)
    for scheme in SPRING_SCHEMES:
        yield from motions.spring_pendulum(scheme)
    for scheme in HIGHER_KEPLER_SCHEMES:
        for e in (0.5, 0.9, 0.99):
            # Few steps, enough for round ellipses only, and steps that resolve the duration of the closest approach.
            part = 0.1 if registered(scheme).order < 8 else 0.2
            for steps in (300, math.ceil(3.0 * math.pi * motions.pericentre_rate(e) / part)):
                yield motions.ellipse(scheme, e, steps)
    for scheme in LONG_SCHEMES:
        substeps = max(1, len(registered(scheme).parts))  # rounding errors grow with their number
        for steps in (1, 10, 1000, 1_000_000):
            yield Case(
                f"oscillator, {steps} steps against the scheme's closed form", "higher order",
                setup("oscillator", scheme), "accurate",
                "only rounding separates the steps from cos(k theta): a phase error of eps a substep, at most",
                steps, (("omega", 3.0), ("duration", steps * 0.1)), every=max(1, steps // 1000),
                reference="discrete_oscillator", bound=motions.EPS * (20.0 + 2.0 * steps * substeps), h_omega=0.3,
            )  # fmt: skip
        if scheme in HIGHER_KEPLER_SCHEMES:
            yield motions.long_ellipse(scheme, "higher order", drift=0.003)
    for name in LANDMARK_SCHEMES:
        yield from landmarks((None, name))
    for name in BODY_SCHEMES:
        yield from bodies((None, name))
        # Two bodies on a circle with a diameter of 0.001, whose period is far below one unit of time.
        gap, steps = 1e-3, 2000
        speed = math.sqrt(2.0 / gap)
        h = 0.1 * gap / speed
        start = (((-gap / 2.0, 0.0), (gap / 2.0, 0.0)), ((0.0, -speed / 2.0), (0.0, speed / 2.0)))
        yield Case(
            f"two bodies on a circle of diameter {gap:g}", "higher order", setup("gravity", (None, name)), "accurate",
            "close bodies are as easy as distant ones for steps in proportion", steps,
            (("start", start), ("m", (1.0, 1.0)), ("duration", h * steps)), reference="two_bodies",
            bound=1.5 * promised((None, name), 0.1, 0.1 * steps), h_omega=0.1,
        )  # fmt: skip


# ---- The registry ----

FAMILIES = {
    "stiff": motions.stiff_cases,
    "dissipative": dissipative_cases,
    "orbits": motions.orbits_cases,
    "chaos": motions.chaos_cases,
    "horizons": motions.horizons_cases,
    "higher order": higher_order_cases,
    "control": control_cases,
    "particles": particle_cases,
    "inputs": motions.inputs_cases,
}
"""The functions that yield the cases of each family, by name."""

QUICK = (
    ("oscillator", "midpoint"),
    ("oscillator", "stormer-verlet"),
    ("oscillator", "explicit-euler"),
    ("kepler", "stormer-verlet"),
    ("linear_regulator", None),
    ("gravity", "stormer-verlet"),
)
"""Problem and scheme of the modules in a quick run; None means the default scheme."""


def all_cases() -> list[Case]:
    """Return every case of every family."""
    return [case for family in FAMILIES.values() for case in family()]


def quick_cases() -> list[Case]:
    """Return the cases of a few modules that compile fast."""
    return [
        case
        for case in all_cases()
        if (case.setup.problem, case.setup.scheme) in QUICK and case.setup.method != "variational"
    ]
