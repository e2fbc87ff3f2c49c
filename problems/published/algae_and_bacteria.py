"""Harvest as much algae as possible from a culture that lives together with bacteria.

s is the substrate, e the bacteria, v the vitamin that they make, q the algae's quota of it and c the algae; alpha is
the share of the bacteria's growth that goes into the vitamin and d the dilution rate. The value is the negative of the
harvest. Source: Mairet and Bayen (2021); CTDirect, test problem "algal_bacterial".
"""

from codegen import Control, controls, states


def problem() -> Control:
    s, e, v, q, c = states("s e v q c")
    alpha, d = controls("alpha d")
    phi = 6.48 * s / (0.09 + s)
    rho = 0.0273 * v / (0.00057 + v)
    mu = 1.0211 * (1 - 0.0027628 / q)
    return Control(
        dynamics={
            s: d * (0.5 - s) - phi * e / 0.44,
            e: ((1 - alpha) * phi - d) * e,
            v: 0.023 * alpha * phi * e - rho * c - d * v,
            q: rho - mu * q,
            c: (mu - d) * c,
        },
        cost=-d * c,
        duration=20,
        start={s: 0.1629, e: 0.0487, v: 0.0003, q: 0.0177, c: 0.035},
        bounds={**dict.fromkeys((s, e, v, c), (0, None)), q: (0.0027628, None), alpha: (0, 1), d: (0, 1.5)},
        steps=500,
    )
