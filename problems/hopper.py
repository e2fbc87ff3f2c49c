"""Move a hopper with one leg forwards from rest to rest with least effort; the sequence of contacts is unknown.

A body with a moment of inertia stands on a leg. A force along the leg changes its length, and a torque at the hip turns
body and leg together. The foot has a mass, and the floor holds the foot by a force in the cone of friction. Whether and
when the hopper jumps is a result. Source: Posa, Cantu and Tedrake (2014), A direct method for trajectory optimization
of rigid bodies through contact; Raibert (1986), Legged robots that balance, for the model.
"""

from sympy import cos, sin

from codegen import Control, controls, coordinates, parameters
from codegen.drawing import Ground, Mass, Rod, Trail


def problem() -> Control:
    (x, y, length, angle), (dx, dy, dlength, dangle) = coordinates("x y l a")
    thrust, torque = controls("thrust torque")
    m, m_f, inertia, g, mu, d = parameters(m=1, m_f=0.1, J=0.05, g=9.81, mu=0.7, d=1)
    foot = x + length * sin(angle), y - length * cos(angle)
    sliding = dx + dlength * sin(angle) + length * cos(angle) * dangle
    rising = dy - dlength * cos(angle) + length * sin(angle) * dangle
    return Control(
        lagrangian=m / 2 * (dx**2 + dy**2)
        + m_f / 2 * (sliding**2 + rising**2)
        + inertia / 2 * dangle**2
        - m * g * y
        - m_f * g * foot[1],
        force={length: thrust, angle: torque},
        cost=thrust**2 + 10 * torque**2,
        duration=1.5,
        start={x: 0, y: 1, length: 1, angle: 0, dx: 0, dy: 0, dlength: 0, dangle: 0},
        end={x: d, y: 1, length: 1, angle: 0, dx: 0, dy: 0, dlength: 0, dangle: 0},
        bounds={length: (0.5, 1.2), angle: (-1, 1)},
        unilateral={"foot": foot[1] >= 0},
        friction=mu,
        slip=[sliding],
        steps=50,
        drawing=[Ground((-0.3, 0), (1.3, 0)), Rod((x, y), foot), Mass((x, y), 0.08), Trail((x, y))],
    )
