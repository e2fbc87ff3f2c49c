"""Optimal control: long horizons, boundary layers, units far from one, tiny durations, large turns, bad guesses."""

from __future__ import annotations

import math
from collections.abc import Iterator

from codegen.evidence.stress.cases import Case
from codegen.evidence.stress.families.common import setup

NAN = math.nan
REFUSED = ("refused",)


def cases() -> Iterator[Case]:
    """All cases of this family."""
    yield from _long()
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
    yield from _cubic()
    # The same transfer in other units has the same cost, times its unit; see docs/guide/limits.md for scaling.
    made = setup("transfer")
    for name in ("m", "GM", "r0"):
        for exponent in (-24, -12, -6, 6, 12, 24):
            factor = 10.0**exponent
            values = (("r0", factor), ("r1", 1.2 * factor)) if name == "r0" else ((name, factor),)
            yield Case(
                f"orbital transfer, {name} times {factor:.0e}", "control", made, "refused",
                "the solver's tolerances are absolute: in such units it solves accurately, or it says that it fails",
                50, values, reference="other_units", bound=1e-3, drift=NAN, allowed=("accurate",),
            )  # fmt: skip
    yield from _turns()
    yield from _walls()


def _regulator(name: str, reason: str, steps: int, rate: float, **values: float) -> Case:
    """A cost in closed form: the midpoint rule promises (h rate)^2/4 of it, and the estimate must show where not."""
    h_rate = rate * values["T"] / steps
    resolved = h_rate < 0.5
    return Case(
        name, "control", setup("linear_regulator"), "accurate" if resolved else "unsuitable", reason, steps,
        tuple(values.items()), doublings=1, reference="regulator", bound=h_rate**2 / 4.0 if resolved else 0.02,
        drift=NAN, h_omega=h_rate, allowed=() if resolved else ("accurate",),
    )  # fmt: skip


def _long() -> Iterator[Case]:
    """Hyper-sensitive: decay and growth by exp(sqrt(2) t) at the two ends, nothing between."""
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


def _cubic() -> Iterator[Case]:
    made = setup("cubic_regulator")
    for T in (10.0, 100.0, 1000.0, 10_000.0):
        steps = round(20 * T)
        yield Case(
            f"cubic hypersensitive, T = {T:g}, {steps} steps", "control", made, "accurate",
            "the fastest rate, 3 x^2 = 6.75 at the end, times the step is 0.34; order 2", steps, (("T", T),),
            reference="cubic_regulator", bound=(6.75 / 20.0) ** 2 / 4.0, drift=NAN, h_omega=6.75 / 20.0,
        )  # fmt: skip
    for noise in (0.1, 1.0, 10.0):
        yield Case(
            f"cubic hypersensitive, T = 100, guess with noise {noise:g}", "control", made, "accurate",
            "the same optimum, or an honest failure", 2000, (("T", 100.0),), noise=noise, reference="cubic_regulator",
            bound=(6.75 / 20.0) ** 2 / 4.0, drift=NAN, h_omega=6.75 / 20.0, allowed=REFUSED,
        )  # fmt: skip
    for begin in (1e3, 1e6, 1e12):
        yield Case(
            f"cubic hypersensitive from x = {begin:g}", "control", made, "refused",
            "x^3 decays within 1/x^2 of time: no grid resolves it, and Newton's method may or may not find the grid's "
            "own solution", 200, (("T", 10.0), ("begin", begin)), drift=NAN, h_omega=3.0 * begin**2 / 20.0,
            allowed=("bounded",),
        )  # fmt: skip


def _turns() -> Iterator[Case]:
    made = setup("arm")
    for T in (1e-9, 1e-6, 1e-3, 1.0):
        yield Case(
            f"arm, nothing to do within T = {T:g}", "control", made, "accurate", "start and end are the same rest",
            50, (("goal", 0.0), ("T", T)), reference="short_turn", bound=1e-16, drift=NAN,
        )  # fmt: skip
    for T in (1e-9, 1e-6, 1e-3):
        yield Case(
            f"arm, one radian within T = {T:g}", "control", made, "accurate",
            "gravity has no time to act; torques go with T^-2, and tolerances are absolute", 50, (("T", T),),
            reference="short_turn", bound=4.0 / 50**2 + T, drift=NAN, allowed=REFUSED,
        )  # fmt: skip
    for turns in (10, 1000, 10**6):
        yield Case(
            f"arm, {turns} turns within T = 1", "control", made, "accurate",
            "gravity averages out over many turns", 50, (("goal", 2.0 * math.pi * turns),), reference="short_turn",
            bound=4.0 / 50**2 + 1.0 / turns, drift=NAN, allowed=REFUSED,
        )  # fmt: skip
    yield Case(
        "arm, rest upright for T = 1", "control", made, "accurate",
        "an unstable rest at both ends: no torque is needed", 50, (("begin", math.pi), ("goal", math.pi)),
        reference="at_rest", bound=1e-12, drift=NAN,
    )  # fmt: skip
    for driver in ("slsqp", "trust-constr", "fsolve"):
        yield Case(
            f"arm, one radian within T = 0.001, by {driver}", "control", made, "accurate",
            "scipy's optimisers on the same equations, scaled", 10, (("T", 1e-3),), driver=driver,
            reference="short_turn", bound=4.0 / 10**2, drift=NAN, allowed=REFUSED,
        )  # fmt: skip


def _walls() -> Iterator[Case]:
    made = setup("walled_cart")
    for wall, steps in ((1.0 / 9.0, 60), (1e-2, 600), (1e-3, 6000)):
        yield Case(
            f"cart, wall at {wall:.3g}, {steps} steps", "control", made, "accurate",
            "the arcs before and after the wall last 3 times its distance, and are resolved", steps, (("wall", wall),),
            reference="walled_cart", bound=(1.0 / (3.0 * wall * steps)) ** 2 * 4.0, drift=NAN, allowed=REFUSED,
        )  # fmt: skip
    for wall in (1e-3, 1e-6, 1e-12):
        yield Case(
            f"cart, wall at {wall:g}, 60 steps", "control", made, "unsuitable",
            "all happens within one step: the doubled grid must show it, or the solver refuses", 60, (("wall", wall),),
            doublings=1, reference="walled_cart", bound=0.02, drift=NAN, allowed=REFUSED,
        )  # fmt: skip
    yield Case(
        "cart, wall behind the start", "control", made, "refused", "the start violates the bound", 60,
        (("wall", -0.1),), drift=NAN,
    )  # fmt: skip
