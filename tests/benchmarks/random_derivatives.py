"""How many random problems are derived without a mismatch.

    python tests/benchmarks/random_derivatives.py [COUNT] [FIRST]

Every module is verified as each build is, against complex steps of the program's own expressions and, where machine
numbers do not decide, against differences with 400 digits. Nothing is compiled. What takes more than 20 s of processor
time is counted as late.
"""

from __future__ import annotations

import signal
import sys
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from random_scalars import random_problem

from codegen.discretise.model.from_problem import normalise
from codegen.emit.lower.module import Origin
from codegen.errors import CodegenError
from codegen.solving.compiler import generate_from_model

_LATEST = 20
ORIGIN = Origin("random.py", "codegen build random.py", "0", ("codegen",))


def _late(*_: object) -> None:
    raise TimeoutError


def _outcome(seed: int) -> tuple[str, str]:
    """What became of a problem in one word, and what an error said."""
    problem, choices = random_problem(seed)
    try:
        signal.setitimer(signal.ITIMER_VIRTUAL, _LATEST)
        try:
            generate_from_model(normalise(problem), choices, ORIGIN)
            return "right", ""
        except CodegenError as error:
            return type(error).__name__, str(error)
        finally:
            signal.setitimer(signal.ITIMER_VIRTUAL, 0)
    except TimeoutError:
        return "late", ""


def main(count: int, first: int) -> int:
    """Build the problems, print what did not pass and how many did; 1 if one has a wrong derivative."""
    outcomes: Counter[str] = Counter()
    begin = time.perf_counter()
    signal.signal(signal.SIGVTALRM, _late)
    for seed in range(first, first + count):
        outcome, said = _outcome(seed)
        outcomes[outcome] += 1
        if said:
            print(f"{seed}: {outcome}: {said[:200]}", flush=True)
        if (seed - first) % 20 == 19:
            print(f"{seed - first + 1} problems: {dict(outcomes)}", flush=True)
    print(dict(outcomes), f"{time.perf_counter() - begin:.0f} s")
    return int(outcomes["VerificationError"] > 0)


if __name__ == "__main__":
    numbers = [int(argument) for argument in sys.argv[1:]]
    sys.exit(main(*(numbers + [1000, 0][len(numbers) :])))
