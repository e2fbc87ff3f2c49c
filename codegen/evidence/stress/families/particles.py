"""Landmarks that nearly meet, lie close to the boundary, turn far or must hurry; bodies of very different mass."""

from __future__ import annotations

import math
from collections.abc import Iterator

from codegen.evidence.stress.cases import Case
from codegen.evidence.stress.families.common import SchemeOf, promised, registered, setup

CONNECT_SCHEMES = ("midpoint", "explicit-euler")
PAIR_SCHEMES = ("stormer-verlet", "symplectic-euler")
NAN = math.nan

Rows = tuple[tuple[float, ...], ...]


def cases() -> Iterator[Case]:
    """All cases of this family."""
    for name in CONNECT_SCHEMES:
        yield from landmarks((None, name))
    for name in PAIR_SCHEMES:
        yield from bodies((None, name))


def turned(count: int, radius: float, angle: float) -> Rows:
    """Points on a circle that turn by an angle."""
    places = [2.0 * math.pi * i / count for i in range(count)]
    return tuple(
        (radius * math.cos(a), radius * math.sin(a), radius * math.cos(a + angle), radius * math.sin(a + angle))
        for a in places
    )


def pair(distance: float, stretch: float) -> Rows:
    """Two points that move by (0.3, 0.1) while their distance changes by a factor."""
    half = distance / 2.0
    return ((-half, 0.0, 0.3 - stretch * half, 0.1), (half, 0.0, 0.3 + stretch * half, 0.1))


def landmarks(scheme: SchemeOf) -> Iterator[Case]:
    """One, two and six landmarks in the unit disc."""
    made = setup("landmarks", scheme)
    steps, order = 20, registered(scheme).order

    def case(name: str, expect: str, reason: str, points: Rows, reference: str = "", bound: float = NAN,
             allowed: tuple[str, ...] = (), number: int = steps, **more: float) -> Case:  # fmt: skip
        return Case(
            f"landmarks, {name}", "particles", made, expect, reason, number, tuple(more.items()), points=points,
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
    """Two bodies that circle each other at unit distance."""
    made = setup("gravity", scheme)
    h, steps = (0.01, 2000) if registered(scheme).order < 4 else (0.1, 200)
    for ratio in (1.0, 1e-6, 1e-12):
        speed = math.sqrt(1.0 + ratio)
        near, far = ratio / (1.0 + ratio), 1.0 / (1.0 + ratio)
        momentum = ratio * speed * far
        yield Case(
            f"two bodies, mass ratio {ratio:g}", "particles", made, "accurate",
            "a circle, order of the scheme; along it, three halves of an error of the semi-major axis add up", steps,
            (("start", (((-near, 0.0), (far, 0.0)), ((0.0, -momentum), (0.0, momentum)))), ("m", (1.0, ratio)),
             ("duration", h * steps)),
            reference="two_bodies", bound=1.5 * promised(scheme, h * speed, h * steps * speed), h_omega=h * speed,
        )  # fmt: skip
    for distance in (1e-3, 1e-9):
        yield Case(
            f"two bodies at rest at distance {distance:g}", "particles", made, "unsuitable",
            "they fall into each other within a step: energy appears from nowhere", steps,
            (("start", (((0.0, 0.0), (distance, 0.0)), ((0.0, 0.0), (0.0, 0.0)))), ("m", (1.0, 1.0)),
             ("duration", h * steps)),
            h_omega=h * distance**-1.5, allowed=("refused",),
        )  # fmt: skip
    yield Case(
        "two bodies at the same place", "particles", made, "refused", "the force is infinite", steps,
        (("start", (((0.0, 0.0), (0.0, 0.0)), ((0.0, 0.0), (0.0, 0.0)))), ("m", (1.0, 1.0)), ("duration", 1.0)),
        h_omega=NAN,
    )  # fmt: skip
