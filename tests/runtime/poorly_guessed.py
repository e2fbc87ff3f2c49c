"""Problems whose guess says little, or the wrong thing, of how large their unknowns are."""

from sympy import cos, exp, log, sin

from codegen import Control, control, controls, free_parameter, parameter, states, time

FIRST, SECOND = 2e-5, 1e-5  # rates of the reactions, 1/s


def reactions(scale: float | None = None) -> Control:
    """A becomes B, and B becomes C, in seconds: from rates of zero nothing is seen of the second one.

    What is followed is the closed form for two rates. `scale` is a typical size of both, if it is to be stated.
    """
    a, b, c = states("a b c")
    p, q = free_parameter("p", 0, lower=0), free_parameter("q", 0, lower=0)
    t = time()
    fed = FIRST / (FIRST - SECOND) * (exp(-SECOND * t) - exp(-FIRST * t))
    made = 1 - exp(-FIRST * t) - fed
    return Control(
        dynamics={a: -p * a, b: p * a - q * b, c: q * b},
        cost=(a - exp(-FIRST * t)) ** 2 + (b - fed) ** 2 + (c - made) ** 2,
        duration=1e5,
        start={a: 1, b: 0, c: 0},
        scale={} if scale is None else {p: scale, q: scale},
        steps=20,
    )


def thrust() -> Control:
    """Move a mass in the plane, from rest to rest, by the least integral of a thrust that is bounded in newtons.

    Thrust at the limit, coasting, thrust at the limit.
    """
    x, y, v, w = states("x y v w")
    a, b, force = controls("a b force")
    m, F, d = parameter("m", 2000), parameter("F", 10000), parameter("d", 600)
    return Control(
        dynamics={x: v, y: w, v: a / m, w: b / m},
        path=[a**2 + b**2 <= force**2],
        cost=force,
        duration=30,
        start={x: 0, y: 0, v: 0, w: 0},
        end={x: 3 * d / 5, y: 4 * d / 5, v: 0, w: 0},
        bounds={force: (0, F)},
        steps=30,
    )


def batch() -> Control:
    """A becomes B, and B becomes C, in a batch whose temperature, in kelvin, is guessed to be zero.

    PROPT, batchReactor: 0.610775 of B at the end.
    """
    a, b = states("a b")
    T = control("T")
    first, second = 4000 * exp(-2500 / T), 6.2e5 * exp(-5000 / T)
    return Control(
        dynamics={a: -first * a**2, b: first * a**2 - second * b},
        terminal_maximise=b,
        duration=1,
        start={a: 1, b: 0},
        bounds={T: (298, 398)},
        steps=40,
    )


def lane() -> Control:
    """Turn a ship onto a parallel lane, 500 m away, in the least time, about a hundred seconds.

    The guess is five minutes, and 800 m ahead all the time. Rudder and rudder rate are bounded. Nomoto's model with a
    cubic damping; numbers are of a small ship at 8 m/s. IPOPT 3.14 finds 147.848102916 on the same program.
    """
    x, y, psi, r, delta = states("x y psi r delta")
    u, T = control("u"), free_parameter("T", 300, lower=10)
    return Control(
        dynamics={x: 8 * cos(psi), y: 8 * sin(psi), psi: r, r: (0.05 * delta - r - 30 * r**3) / 25, delta: u},
        terminal_cost=T,
        duration=T,
        start={x: 0, y: 0, psi: 0, r: 0, delta: 0},
        end={y: 500, psi: 0, r: 0, delta: 0},
        bounds={delta: (-0.6, 0.6), u: (-0.05, 0.05)},
        guess={x: 800},
        steps=20,
    )


def charging() -> Control:
    """Charge a battery from a tenth to 80 percent in the least time, by a current that is bounded.

    At the guess, without a current, nothing but rounding changes with the duration. IPOPT 3.14 finds 579.3235674463 on
    the same program, 20 intervals.
    """
    charge, over, heat = states("soc V1 T")
    current, duration = control("I"), free_parameter("tf", 3000, lower=100)
    return Control(
        dynamics={
            charge: current / (2.3 * 3600),
            over: -over / (0.016 * 2500) + current / 2500,
            heat: (0.01 * current**2 + over * current - (heat - 298) / 3.0) / 60,
        },
        terminal_cost=duration,
        duration=duration,
        start={charge: 0.1, over: 0, heat: 298},
        end={charge: 0.8},
        path=[3.2 + 0.9 * charge + 0.05 * log(charge / (1 - charge)) + over + 0.01 * current <= 4.1],
        bounds={current: (0, 12), heat: (None, 308), charge: (0.01, 0.99)},
        steps=20,
    )


def yeast(unit: float = 1.0) -> Control:
    """Feed yeast such that most protein is secreted; what is made of it while food abounds is exp(-25) of its amount.

    Source: Park and Ramirez (1988), Optimal production of secreted protein in fed-batch reactors. `unit` is that of
    proteins, in which amounts of them are stated.
    """
    secreted, total, cells, food, volume = states("secreted total cells food volume")
    feed = control("feed")
    growth = 21.87 * food / ((food + 0.4) * (food + 62.5))
    made = food * exp(-5 * food) / (0.1 + food)
    return Control(
        dynamics={
            secreted: 4.75 * growth / (0.12 + growth) * (total - secreted) - feed / volume * secreted,
            total: made / unit * cells - feed / volume * total,
            cells: (growth - feed / volume) * cells,
            food: -7.3 * growth * cells - feed / volume * (food - 20),
            volume: feed,
        },
        terminal_cost=-secreted * unit * volume,
        duration=15,
        start={secreted: 0, total: 0, cells: 1, food: 5, volume: 1},
        bounds={feed: (0, 2), food: (0, None), cells: (0, None), volume: (0.5, None)},
        guess={feed: 0.8},
        steps=40,
    )
