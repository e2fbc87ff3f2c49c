"""Count iterations of controllers after a push: warm searches from a solution whose start is another one.

    python tests/benchmarks/pushed_starts.py [--cases N]

Each problem is solved from its own start. Then its start is moved by chance, by about a third of each value or of one
(the quadrotor also by half a metre, two metres a second and 0.4 rad), as far as the equations are violated by more than
0.1, and the search begins from that solution. Starts from which it finds no solution are left out, and counted.
"""

import argparse
from pathlib import Path

import numpy as np

import codegen
from codegen.mpc.acceptance import BestIterate
from codegen.runtime.search.cascade import minimise

PROBLEMS = Path(__file__).resolve().parents[2] / "problems"
QUADROTOR = np.repeat([0.5, 2.0, 0.4], 3)
CASES = (
    ("quadrotor_path", 30, QUADROTOR), ("quadrotor_path", 30, 0.25 * QUADROTOR), ("crane", 60, None),
    ("published/free_flying_robot", 60, None), ("published/lotka_volterra_fishing", 60, None),
)  # fmt: skip
FAR, MOST = 0.1, 600


def iterations_of(name: str, steps: int, sizes: np.ndarray | None, count: int) -> tuple[list[int], int]:
    """The iterations from so many starts, and from how many no solution was found."""
    module = codegen.Controller(PROBLEMS / f"{name}.py", steps=steps, scaling="none").module
    names = module.metadata.start
    grid, solution = module.make_grid(steps), module.solve(steps, scaling="none")
    first = len(module.metadata.parameters)
    start, generator = grid.parameters[0, first : first + len(names)].copy(), np.random.default_rng(0)
    sizes = 0.3 * np.maximum(1.0, np.abs(start)) if sizes is None else sizes
    found, unsolved = [], 0
    for _ in range(10 * count):
        state = start + sizes * generator.standard_normal(start.size) * generator.choice([0.3, 1.0, 2.0])
        pushed, guess = module.make_grid(steps, start=dict(zip(names, state, strict=True))), solution.unknowns.copy()
        module.pin_values(pushed, guess, module.views(pushed, guess)[0])
        if module.evaluate(pushed, guess).residual < FAR:
            continue
        log = BestIterate(np.inf, 0.0)
        status, _, iterations = minimise(pushed, guess, 1e-8, MOST, True, log)
        if status == "solved":
            found.append(iterations)
        unsolved += status != "solved"
        if len(found) == count:
            break
    return found, unsolved


def main() -> None:
    """Print a line for each problem."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=60)
    options = parser.parse_args()
    print(f"{'problem':34} solved left out   mean median  90 %  most")
    for name, steps, sizes in CASES:
        found, unsolved = iterations_of(name, steps, sizes, options.cases)
        numbers = np.mean(found), np.median(found), np.percentile(found, 90), np.max(found)
        print(
            f"{name:34} {len(found):6d} {unsolved:8d} " + " ".join(f"{number:6.1f}" for number in numbers), flush=True
        )


if __name__ == "__main__":
    main()
