"""How many random problems are derived without a mismatch.

    python tests/benchmarks/random_derivatives.py [COUNT] [FIRST]

Every module is verified as each build is, against complex steps of the program's own expressions and, where machine
numbers do not decide, against differences with 400 digits. Nothing is compiled. What takes longer than 20 s is counted
as late.
"""

from __future__ import annotations

import signal
import sys
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from random_scalars import random_problem

from codegen.compiler import generate_from_model
from codegen.errors import CodegenError
from codegen.lower.module import Origin
from codegen.model import normalise

_LATEST = 20
ORIGIN = Origin("random.py", "codegen build random.py", "0", ("codegen",))


def _late(*_: object) -> None:
    raise TimeoutError


def main(count: int, first: int) -> int:
    """Build the problems, print what did not pass and how many did; 1 if one has a wrong derivative."""
    outcomes: Counter[str] = Counter()
    begin = time.perf_counter()
    signal.signal(signal.SIGALRM, _late)
    for seed in range(first, first + count):
        problem, choices = random_problem(seed)
        signal.alarm(_LATEST)
        try:
            generate_from_model(normalise(problem), choices, ORIGIN)
            outcomes["right"] += 1
        except CodegenError as error:
            outcomes[type(error).__name__] += 1
            print(f"{seed}: {type(error).__name__}: {str(error)[:200]}", flush=True)
        except TimeoutError:
            outcomes["late"] += 1
        finally:
            signal.alarm(0)
        if (seed - first) % 20 == 19:
            print(f"{seed - first + 1} problems: {dict(outcomes)}", flush=True)
    print(dict(outcomes), f"{time.perf_counter() - begin:.0f} s")
    return int(outcomes["VerificationError"] > 0)


if __name__ == "__main__":
    numbers = [int(argument) for argument in sys.argv[1:]]
    sys.exit(main(*(numbers + [1000, 0][len(numbers) :])))
