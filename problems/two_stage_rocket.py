"""Send a sounding rocket of two stages as high as its fuel can bring it.

The rocket rises vertically through constant gravity and no air; r is its height in km, v its speed in km/s and m its
mass in tonnes, so that the thrust, between one half and all of F, is in meganewtons. Each stage burns all its fuel; the
first one is then dropped, and after the second the rocket coasts to the top of its flight. When the stages burn out is
free. Source of the equations: Tsiolkovsky (1903); the numbers are those of no particular rocket.

Every second of burning costs g in speed, so both stages burn at full thrust. A stage that burns from the mass m to m/R
in the time T = c (1 - 1/R) m/F, with exhaust speed c and thrust F, gains the speed c log(R) - g T and the height
v T + c T (1 - log(R)/(R - 1)) - g T^2/2, and coasting adds v^2/(2 g): altogether 568.6954318 km.
"""

from codegen import Control, Phases, control, free_parameter, parameters, states


def problem() -> Phases:
    r, v, m = states("r v m")
    thrust = control("thrust")
    g = parameters(g=0.00981)[0]
    m_0, fuel_1, dry_1, fuel_2 = parameters(m_0=1.5, fuel_1=0.8, dry_1=0.15, fuel_2=0.3)
    F_1, c_1, F_2, c_2 = parameters(F_1=0.06, c_1=2.3, F_2=0.012, c_2=2.6)
    T_1, T_2 = free_parameter("T_1", guess=40, lower=1), free_parameter("T_2", guess=80, lower=1)
    T_3 = free_parameter("T_3", guess=200, lower=1)
    m_1 = m_0 - fuel_1
    m_2 = m_1 - dry_1

    first = Control(
        dynamics={r: v, v: thrust / m - g, m: -thrust / c_1},
        duration=T_1,
        start={r: 0, v: 0, m: m_0},
        end={m: m_1},
        bounds={thrust: (F_1 / 2, F_1)},
        guess={thrust: 0.75 * F_1},
        steps=20,
    )
    second = Control(
        dynamics={r: v, v: thrust / m - g, m: -thrust / c_2},
        duration=T_2,
        end={m: m_2 - fuel_2},
        bounds={thrust: (F_2 / 2, F_2)},
        guess={thrust: 0.75 * F_2},
        steps=20,
    )
    coast = Control(
        dynamics={r: v, v: -g, m: 0},
        duration=T_3,
        end={v: 0},
        terminal_cost=-r,
        steps=20,
    )
    return Phases(first, second, coast, jumps=[{m: m - dry_1}, {}])
