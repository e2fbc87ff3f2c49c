"""Every scheme on the pendulum: measured order, symplecticity, the trend of the energy's error over a million steps.

`python tests/benchmarks/scheme_orders.py [SCHEME ...]`. The schemes for first-order dynamics x' = f(x) come first, with
their orders alone. The exact motion is that of elliptic functions, in 30 digits.
The rest is that of the section "energy in the long run" of reports (`codegen/evidence/report/simulations.py`): the
defect |S'JS - J| of the emitted step, and the rise of a straight line through the energy's error with its standard
error and t value, beside the random walk by rounding.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import sympy

sys.path[:0] = [str(Path(__file__).parents[1])]

from simulation_systems import model_of, text_of  # noqa: E402

import codegen  # noqa: E402
from codegen import Simulate, states  # noqa: E402
from codegen.discretise import schemes  # noqa: E402
from codegen.emit import rendering  # noqa: E402
from codegen.evidence.report.simulations import drift_values, trend_in_words  # noqa: E402
from codegen.solving.compiler import cache_folder  # noqa: E402
from codegen.solving.loading import load  # noqa: E402

MOMENTUM, DURATION, LONG = 1.4, 2.0, 1_000_000
STEPS = {
    1: (100, 200, 400), 2: (100, 200, 400), 3: (50, 100, 200), 4: (40, 80, 160), 5: (10, 20, 40), 6: (6, 12, 24),
    8: (5, 7, 10),
}  # fmt: skip


def exact_state(t: float) -> Any:
    """(q, p) with q(0) = 0 and p(0) = 2 k: sin(q/2) = k sn(t, k) and p = 2 k cn(t, k)."""
    with mpmath.workdps(30):
        k = mpmath.mpf(MOMENTUM) / 2
        sn, cn = (mpmath.ellipfun(name, t, m=k**2) for name in ("sn", "cn"))
        return np.array([float(2 * mpmath.asin(k * sn)), float(2 * k * cn)])


def first_order(chosen: list[str]) -> None:
    """Print the orders of the schemes for first-order dynamics, on the pendulum as a system of first order."""
    q, p = states("q p")
    pendulum = Simulate(dynamics={q: p, p: -sympy.sin(q)}, duration=DURATION, start={q: 0, p: MOMENTUM})
    print(f"{'scheme, first-order':24} order measured   error")
    for scheme in schemes.of_method(schemes.FIRST_ORDER):
        if chosen and scheme.name not in chosen:
            continue
        module: Any = codegen.compile(pendulum, scheme=scheme.name).module
        counts = STEPS[scheme.order]
        ends = [module.solve(n).q[-1] for n in counts]
        errors = [np.linalg.norm(end - exact_state(DURATION)) for end in ends]
        measured = np.log(errors[-2] / errors[-1]) / np.log(counts[-1] / counts[-2])
        print(f"{scheme.name:24} {scheme.order:5d} {measured:8.3f} {errors[-1]:7.1e}", flush=True)


def main() -> None:
    """Print both tables."""
    first_order(sys.argv[1:])
    chosen = [name for name in sys.argv[1:] or schemes.METHODS["hamiltonian"] if name in schemes.METHODS["hamiltonian"]]
    print(
        f"{'scheme':24} order measured   error symplectic   defect    swings  at first       rise "
        "std. error        t  rounding"
    )
    for name in chosen:
        path = cache_folder() / f"bench_{name.replace('-', '_')}.py"
        rendering.write(path, text_of(model_of("pendulum-hamiltonian"), name, "hamiltonian"))
        module = load(path)
        order = module.metadata.order
        counts, start = STEPS[order], (0.0, MOMENTUM)
        errors = []
        for n in counts:
            solution = module.solve(n, duration=DURATION, start=start)
            errors.append(np.hypot(*(np.array([solution.q[-1, 0], solution.p[-1, 0]]) - exact_state(DURATION))))
        measured = np.log(errors[-2] / errors[-1]) / np.log(counts[-1] / counts[-2])
        values, symplectic = drift_values(module, LONG), schemes.find(name, "hamiltonian").symplectic
        begin = f"{name:24} {order:5d} {measured:8.3f} {errors[-1]:7.1e} {'yes' if symplectic else 'no':>10} "
        if values["status"] != "solved":
            print(f"{begin} {values.get('defect', np.nan):8.1e} {values['status']}", flush=True)
            continue
        print(
            f"{begin} {values['defect']:8.1e} {values['oscillation']:9.1e} {values['first']:9.1e} "
            f"{values['rise']:10.1e} {values['standard error']:9.1e} {values['t']:8.2f} {values['rounding']:9.1e} "
            f"{trend_in_words(values)}",
            flush=True,
        )


if __name__ == "__main__":
    main()
