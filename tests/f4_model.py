"""The model from which the tables of `problems/published/time_to_climb.py` are made, and the making of their files.

    python tests/f4_model.py        writes problems/data/f4_*.csv anew

An F-4 with two J79 engines: thrust as a polynomial in Mach number and altitude, lift and drag as functions of the Mach
number. Source: Bryson (1999), Dynamic optimization, as in OpenMDAO/dymos, examples/min_time_climb. The atmosphere is
that of the U.S. Standard Atmosphere (1976) below 32 km.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).parents[1] / "problems" / "data"
FOOT, POUND = 0.3048, 4.4482216
"""In metres and in newtons."""
THRUST = (
    (30.21, -0.668877, -6.877, 1.951, -0.1512),
    (-33.8, 3.347, 18.13, -5.865, 0.4757),
    (100.8, -77.56, 5.441, 2.864, -0.3355),
    (-78.99, 101.4, -30.28, 3.236, -0.1089),
    (18.74, -31.6, 12.04, -1.785, 0.09417),
)
"""Coefficients of M^i z^j, in thousands of pounds, z the altitude in units of 10,000 feet."""
MACH, FEET = np.linspace(0.0, 1.8, 10), np.array([0, 5, 10, 15, 20, 25, 30, 40, 50, 70]) * 1e3
FINE_MACH = np.array([*range(0, 700, 100), *range(700, 1300, 25), *range(1300, 1801, 100)]) / 1e3
ALTITUDES = np.array([*range(0, 9000, 1000), *range(9000, 13000, 250), *range(13000, 22001, 1000)], dtype=float)


def thrust(mach: np.ndarray, altitude: np.ndarray) -> np.ndarray:
    """Newtons, altitude in metres."""
    z = np.asarray(altitude) / FOOT / 1e4
    return 1e3 * POUND * sum(c * mach**i * z**j for i, row in enumerate(THRUST) for j, c in enumerate(row))


def zero_lift_drag(mach: np.ndarray) -> np.ndarray:
    """C_D0, nondimensional."""
    low = np.minimum(mach, 1.15)
    return 0.013 + 0.0144 * (1 + np.tanh((low - 0.98) / 0.06)) - 0.011 * (mach - low)


def lift_slope(mach: np.ndarray) -> np.ndarray:
    """The derivative of C_L by the angle of attack, 1/rad."""
    low = np.minimum(mach, 1.15)
    return 3.44 + 1 / np.cosh((low - 1.0) / 0.06) ** 2 - 0.96 / 0.63 * (mach - low)


def induced_drag(mach: np.ndarray) -> np.ndarray:
    """What C_D = C_D0 + kappa C_La alpha^2 has for kappa, nondimensional."""
    low = np.minimum(mach, 1.15)
    return 0.54 + 0.15 * (1 + np.tanh((low - 0.9) / 0.06)) + 0.14 * (mach - low)


def atmosphere(altitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Density in kg/m^3 and speed of sound in m/s at geometric altitudes in metres, below 32 km."""
    g, gas, radius = 9.80665, 287.05287, 6356766.0
    height = radius * altitude / (radius + altitude)  # geopotential
    low, high = np.minimum(height, 11e3), np.clip(height - 20e3, 0.0, None)
    temperature = 288.15 - 6.5e-3 * low + 1e-3 * high
    pressure = 101325.0 * (1 - 6.5e-3 * low / 288.15) ** (g / gas / 6.5e-3)
    pressure *= np.exp(-g * np.clip(height - 11e3, 0.0, 9e3) / gas / 216.65)
    pressure *= (1 + 1e-3 * high / 216.65) ** (-g / gas / 1e-3)
    return pressure / gas / temperature, np.sqrt(1.4 * gas * temperature)


def tables() -> dict[str, tuple[str, str, Sequence[np.ndarray]]]:
    """Of each file what it says of itself, the names of its columns, and the columns."""
    mach, altitude = (part.ravel() for part in np.meshgrid(MACH, FEET * FOOT, indexing="ij"))
    aero = [zero_lift_drag(FINE_MACH), lift_slope(FINE_MACH), induced_drag(FINE_MACH)]
    return {
        "f4_thrust.csv": (
            "thrust of two J79 engines, m and N",
            "mach,altitude,thrust",
            [mach, altitude, thrust(mach, altitude)],
        ),
        "f4_aerodynamics.csv": ("lift and drag of an F-4, 1/rad", "mach,C_D0,C_La,kappa", [FINE_MACH, *aero]),
        "f4_atmosphere.csv": (
            "U.S. Standard Atmosphere 1976, m, kg/m^3, m/s",
            "altitude,density,sound",
            [ALTITUDES, *atmosphere(ALTITUDES)],
        ),
    }


def text_of(name: str) -> str:
    """The text of a file; numbers have nine digits."""
    about, header, columns = tables()[name]
    rows = "".join(",".join(f"{number:.9g}" for number in row) + "\n" for row in np.stack(columns, axis=1).tolist())
    source = "made by tests/f4_model.py" + (
        "" if "Atmosphere" in about else " from Bryson (1999), Dynamic optimization"
    )
    return f"# {about}; {source}\n{header}\n{rows}"


if __name__ == "__main__":
    for file in tables():
        (FOLDER / file).write_text(text_of(file))
