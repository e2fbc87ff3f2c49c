"""Register two images by landmarks: find the geodesic interpolating spline that carries one set of points to another.

Landmarks q_i with momenta p_i move by H = 1/2 sum_ij p_i . p_j G(q_i, q_j). With `plate`, G is the Green's function of
the clamped plate that fills the unit disc, so that the map which moves the points moves nothing on the circle and
beyond, does not fold, and has the least bending energy (in units in which G is 8 pi times that of the biharmonic
operator). In space it is that of the unit ball, times 16 pi. With `gauss`, G is a Gaussian of width sigma and space
has no boundary.
Source: Camion and Younes (2001), Geodesic interpolating splines; Mills and Marsland (2005); Mills, Shardlow and
Marsland (2006), Computing the geodesic interpolating spline; Boggio (1905) for both Green's functions, of which the
second is written without differences of roots. All quantities are nondimensional.

The 40 landmarks of data/trilobite40.csv are homologous points of two trilobite cephala (Jujuyaspis keideli), from
Serra et al. (2023), Scientific Data, as in the package ktch (Apache-2.0), aligned by a similarity and scaled into the
disc of radius 0.7.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from sympy import Expr, Max, Rational, atanh, exp, log, sqrt, tanh

from codegen import Connect, Pairwise, Points, parameter, particles

Vector = Sequence[Expr]


def dot(x: Vector, y: Vector) -> Expr:
    return sum(a * b for a, b in zip(x, y, strict=True))


def squared_distance(x: Vector, y: Vector) -> Expr:
    return sum((a - b) ** 2 for a, b in zip(x, y, strict=True))


def plate(x: Vector, y: Vector) -> Expr:
    """The Green's function of the clamped plate or ball, from distances to its boundary and between the points."""
    ab, s = (1 - dot(x, x)) * (1 - dot(y, y)), squared_distance(x, y)
    if len(x) == 2:
        return ab / 2 - s / 2 * log(1 + ab / s)
    return ab**2 / (sqrt(s + ab) * (sqrt(s + ab) + sqrt(s)) ** 2)


def arc(x: Vector, y: Vector, fraction: Expr) -> list[Expr]:
    """The way of a single landmark: a hyperbolic line of the disc, at constant speed.

    It is the straight line from the origin after the Moebius map z -> (z - x)/(1 - x* z), which moves x there; so there
    is no special case for points at the origin, on one diameter, or that do not move.
    """

    def quotient(a: Vector, b: Vector) -> list[Expr]:
        return [(a[0] * b[0] + a[1] * b[1]) / dot(b, b), (a[1] * b[0] - a[0] * b[1]) / dot(b, b)]

    def shifted(z: Vector, by: Vector) -> list[Expr]:
        real, imaginary = dot(by, z), by[0] * z[1] - by[1] * z[0]
        return quotient([z[0] + by[0], z[1] + by[1]], [1 + real, imaginary])

    w = shifted(y, [-x[0], -x[1]])
    radius = sqrt(Max(dot(w, w), Rational(1, 10**30)))
    stretch = tanh(fraction * atanh(radius)) / radius
    return shifted([stretch * w[0], stretch * w[1]], x)


def problem(
    landmarks: Points = Path("data/trilobite40.csv"),
    kernel: Literal["plate", "gauss"] = "plate",
    dimension: Literal[2, 3] = 2,
    path: Literal["arc", "straight"] = "arc",
    passive: bool = False,
    parallel: bool = False,
) -> Connect:
    i, j = particles("x y z"[: 2 * dimension - 1], "px py pz"[: 3 * dimension - 1])
    if kernel == "plate":
        green, domain = plate(i.q, j.q), [1 - dot(i.q, i.q)]
    else:
        green, domain = exp(-squared_distance(i.q, j.q) / (2 * parameter("width", 0.5) ** 2)), []
    curved = path == "arc" and kernel == "plate" and dimension == 2
    return Connect(
        hamiltonian=Pairwise((i, j), pair_term=dot(i.p, j.p) * green, domain=domain),
        points=landmarks,
        path=arc if curved else None,
        passive=passive,
        parallel=parallel,
        steps=10,
    )
