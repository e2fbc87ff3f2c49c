"""Seconds of `codegen.compile` for the same problem from a file and as an object, cold and warm, each in a new process.

    python tests/benchmarks/objects.py [PROBLEM ...]

prints a row for each problem and way: derivation and compilation where the cache is empty, the call where it has both,
a first solve after that; and what a further solve takes beside its numerics.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
PROBLEMS = ("orbital_transfer", "brachistochrone", "hovercraft")

PROCESS = """
import sys, time
sys.path.insert(0, {tests!r})
begin = time.perf_counter()
import codegen
from pathlib import Path
file = Path({file!r})
if {kind!r} == "object":
    from codegen.problem.sources import written_problem
    title, problem, _ = written_problem(file, {{}})
    given, named = problem, dict(name=file.stem, title=title)
else:
    given, named = file, {{}}
imported = time.perf_counter()
solver = codegen.compile(given, **named)
compiled = time.perf_counter()
result = solver.solve()
solved = time.perf_counter()
from statistics import median
again = []
for _ in range(20):
    start = time.perf_counter()
    result = solver.solve()
    again.append(time.perf_counter() - start - result.seconds_solve)
print(imported - begin, compiled - imported, solved - compiled, median(again), solver.build.cached, result.cost)
"""


def measured(problem: str, kind: str, cache: str, seed: str) -> list[str]:
    """What one process prints, preceded by nothing else."""
    code = PROCESS.format(tests=str(ROOT / "tests"), file=str(ROOT / "problems" / f"{problem}.py"), kind=kind)
    environment = {**os.environ, "CODEGEN_CACHE_DIR": cache, "PYTHONHASHSEED": seed, "PYTHONPATH": str(ROOT)}
    words = [sys.executable, "-c", code]
    return subprocess.run(words, env=environment, capture_output=True, text=True, check=True, cwd=cache).stdout.split()


def main() -> None:
    """Measure every problem both ways."""
    print(f"{'problem':<18}{'from':<8}{'':<6}{'imports':>9}{'compile':>9}{'1st solve':>10}{'each':>9}  cached  cost")
    for problem in sys.argv[1:] or PROBLEMS:
        for kind in ("file", "object"):
            with tempfile.TemporaryDirectory() as cache:
                for state, seed in (("cold", "1"), ("warm", "2"), ("warm", "3")):
                    imports, made, first, each, cached, cost = measured(problem, kind, cache, seed)
                    numbers = f"{float(imports):9.2f}{float(made):9.2f}{float(first):10.2f}{1e3 * float(each):6.2f} ms"
                    print(f"{problem:<18}{kind:<8}{state:<6}{numbers}  {cached:<6}  {cost}", flush=True)


if __name__ == "__main__":
    main()
