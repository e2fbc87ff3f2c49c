"""Recompute the optima in `tests/gallery_references.py` with CasADi and IPOPT.

    python tests/benchmarks/gallery_optima.py [--steps N ...] [--collocation N] [PROBLEM ...]

For every problem the optimum of the very program that our solver solves, at each N, to a tolerance of 1e-12 and
without IPOPT's usual relaxation of bounds; from the last two N the limit by Richardson's extrapolation with order 2;
and, on demand, the optimum by Gauss-Legendre collocation of order 6.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
from collections.abc import Sequence
from time import perf_counter

from peers.casadi_collocation import PreparedCollocation
from peers.casadi_gallery import PreparedGallery, holonomic_count
from peers.gallery_problem import GalleryProblem
from peers.gallery_table import GALLERY
from rich.console import Console
from rich.table import Table

PRECISE = {
    "ipopt.tol": 1e-12,
    "ipopt.constr_viol_tol": 1e-11,
    "ipopt.compl_inf_tol": 1e-12,
    "ipopt.bound_relax_factor": 0.0,
    "ipopt.max_iter": 2000,
}


def optimum(problem: GalleryProblem, steps: int) -> tuple[float, int, float, str]:
    """Cost, iterations, seconds and status."""
    prepared = PreparedGallery(problem, steps, options=PRECISE)
    prepared.run()
    started = perf_counter()
    prepared.run()
    seconds, report = perf_counter() - started, prepared.report()
    return report["cost"], report["iterations"], seconds, report["status"]


def add_rows(table: Table, name: str, problem: GalleryProblem, steps: Sequence[int], collocation: int) -> None:
    """One row for each N, and one for the limit."""
    found = []
    for n in steps:
        cost, iterations, seconds, status = optimum(problem, n)
        found.append(cost)
        table.add_row(name, str(n), f"{cost:.12g}", str(iterations), f"{1e3 * seconds:.1f}", status)
    if len(found) > 1:
        (*_, first, second), (*_, few, many) = found, steps
        ratio = (many / few) ** 2
        table.add_row("", "limit", f"{(ratio * second - first) / (ratio - 1):.9g}")
    if collocation and problem.bodies == 1 and not holonomic_count(problem):
        collocated = PreparedCollocation(problem, collocation, **PRECISE)
        collocated.run()
        table.add_row("", f"Gauss, {collocation}", f"{collocated.cost:.10g}", "", "", collocated.status)
    table.add_section()


def main() -> None:
    """Print the table of the problems asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", help="names of problems, all of them by default")
    parser.add_argument("--steps", type=int, nargs="+", default=[50, 100])
    parser.add_argument("--collocation", type=int, default=0, help="intervals of the Gauss-Legendre collocation")
    arguments = parser.parse_args()
    table = Table(title="Optima by CasADi and IPOPT", title_justify="left")
    for column in ("problem", "N", "optimum", "iterations", "ms", "status"):
        table.add_column(column, justify="left" if column in ("problem", "status") else "right", no_wrap=True)
    for (name, settings), make in GALLERY.items():
        if arguments.problems and name not in arguments.problems:
            continue
        title = " ".join([name, *(f"{key}={value}" for key, value in settings)])
        add_rows(table, title, make(), arguments.steps, arguments.collocation)
    Console(width=130).print(table)


if __name__ == "__main__":
    main()
