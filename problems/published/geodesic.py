"""Fly from New York to London by the shortest way over the earth, an ellipsoid of revolution.

Kilometres and hours; the speed is 900 km/h, its direction (sin a cos b, sin a sin b, cos a) is the control, and the
place stays on the surface. The value is the length of the way. Source: PSOPT, example "geodesic".
"""

from sympy import Eq, cos, rad, sin

from codegen import Control, controls, free_parameter, states

EQUATOR, POLE = 6384, 6353


def place(latitude: float, longitude: float) -> tuple[object, object, object]:
    """A place on the earth, with the longitude counted as in the source."""
    colatitude, east = rad(90 - latitude), rad(360 - abs(longitude))
    return EQUATOR * sin(colatitude) * cos(east), EQUATOR * sin(colatitude) * sin(east), POLE * cos(colatitude)


def problem() -> Control:
    x, y, z = states("x y z")
    a, b = controls("a b")
    T = free_parameter("T", 6, lower=0)
    return Control(
        dynamics={x: 900 * sin(a) * cos(b), y: 900 * sin(a) * sin(b), z: 900 * cos(a)},
        terminal_cost=900 * T,
        duration=T,
        start=dict(zip((x, y, z), place(40.6413, -73.7781), strict=True)),
        end=dict(zip((x, y, z), place(51.47, -0.4543), strict=True)),
        path=[Eq((x**2 + y**2) / EQUATOR**2 + z**2 / POLE**2, 1)],
        steps=100,
    )
