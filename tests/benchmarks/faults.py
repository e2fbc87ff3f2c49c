"""Faults at random moments of builds and solves: kills, damaged files, full disks, read-only folders.

    python tests/benchmarks/faults.py [--count 200] [--seed 0]

Every round runs a command under a fault, or damages what earlier ones have left. The next command must give the right
answer or a typed error, and the one after, with the cause gone, the right answer. It prints a table and exits with
status 1 if a round does not. Full and read-only disks need the right to mount one, and are left out without it.

The rounds share one folder, so that each begins with what the one before has healed. Kills fall within the time that
the command has been seen to take, and five rounds of six take the problem that is compiled most quickly.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from injected_faults import ANSWERS, DAMAGE, Sandbox, filled, limited_files, read_only, small_disk
from rich.console import Console
from rich.table import Table

Outcome = tuple[str, str, str]
"""What was done, how the next command ended, and how the one after did."""
COMMANDS = ("build", "solve")
OFTEN = ("oscillator",) * 9 + tuple(ANSWERS)
"""Problems as often as they are drawn."""


def killed(box: Sandbox, rng: random.Random) -> Outcome:
    """A command dies at a random moment, with or without the processes that compile for it."""
    name, kind, compilers = rng.choice(OFTEN), rng.choice(COMMANDS), rng.random() < 0.5
    fresh = rng.random() < 0.7
    if fresh:  # there is something to derive and to compile
        for path in [*box.cached_texts(), *box.machine_code()]:
            if path.name.startswith(f"{name}."):
                path.unlink()
    delay = rng.uniform(0.05, box.seconds["build" if fresh else kind, name])
    box.killed(kind, name, delay, compilers)
    label = f"{kind} of {name} after {delay:.1f} s{', with its processes' if compilers else ''}"
    return label, box.run(rng.choice((*COMMANDS, "import")), name), box.run("solve", name)


def damaged_text(box: Sandbox, rng: random.Random) -> Outcome:
    """A text in the build cache is cut off, emptied or altered."""
    return _damaged(box, rng, box.cached_texts(), COMMANDS)


def damaged_code(box: Sandbox, rng: random.Random) -> Outcome:
    """A file of machine code is cut off, emptied or altered."""
    return _damaged(box, rng, box.machine_code(), (*COMMANDS, "import"))


def _damaged(box: Sandbox, rng: random.Random, paths: list[Path], kinds: tuple[str, ...]) -> Outcome:
    name, kind = rng.choice(OFTEN), rng.choice(kinds)
    own = [path for path in paths if path.name.startswith(f"{name}.")]
    chosen = rng.sample(own, min(len(own), rng.choice((1, 1, 3, 20))))
    damage = rng.choice(DAMAGE)
    for path in chosen:
        if path.stat().st_size:
            damage(path, rng)
    label = f"{damage.__name__}: {len(chosen)} files of {name}, then {kind}"
    after = "import" if kind == "build" else "solve"
    return label, box.run(kind, name), box.run(after, name)


def full(box: Sandbox, rng: random.Random) -> Outcome:
    """The disk has room for a part of what a command writes."""
    name, kind, left = rng.choice(OFTEN), rng.choice(COMMANDS), rng.choice((0, 5_000, 50_000, 300_000, 1_000_000))
    _forget(box, rng, name)
    with filled(box.folder, left):
        first = box.run(kind, name)
    return f"{kind} of {name} with {left} bytes left", first, box.run("solve", name)


def limited(box: Sandbox, rng: random.Random) -> Outcome:
    """Files may not grow beyond a size."""
    name, kind, size = rng.choice(OFTEN), rng.choice(COMMANDS), rng.choice((0, 1_000, 20_000, 100_000))
    _forget(box, rng, name)
    first = box.run(kind, name, limited_files(size))
    return f"{kind} of {name} with files up to {size} bytes", first, box.run("solve", name)


def unwritable(box: Sandbox, rng: random.Random) -> Outcome:
    """The disk may only be read."""
    name, kind = rng.choice(OFTEN), rng.choice(COMMANDS)
    _forget(box, rng, name)
    with read_only(box.folder):
        first = box.run(kind, name)
    return f"{kind} of {name}", first, box.run("solve", name)


def _forget(box: Sandbox, rng: random.Random, name: str) -> None:
    """Remove texts or machine code of a module, so that there is something to write."""
    for paths in (box.cached_texts(), box.machine_code()):
        if rng.random() < 0.5:
            for path in paths:
                if path.name.startswith(f"{name}."):
                    path.unlink()


ANYWHERE: tuple[Callable[[Sandbox, random.Random], Outcome], ...] = (killed, damaged_text, damaged_code, limited)
MOUNTED = (*ANYWHERE, full, unwritable)


def rounds(box: Sandbox, faults: tuple[Callable[[Sandbox, random.Random], Outcome], ...], count: int, seed: int) -> int:
    """Run so many rounds, print what happened, and return how many went wrong."""
    rng, wrong, seen = random.Random(seed), list[str](), Counter[tuple[str, str]]()
    for number in range(count):
        fault, begin = faults[number % len(faults)], time.perf_counter()
        label, first, second = fault(box, rng)
        bad = first not in ("right", "typed error") or second != "right"
        seen[fault.__name__, "violated" if bad else first] += 1
        line = (
            f"{number + 1:3d} {fault.__name__}: {label}: {first}, then {second} ({time.perf_counter() - begin:.0f} s)"
        )
        print(line, file=sys.stderr, flush=True)
        wrong += [line] if bad else []
    table = Table("fault", "rounds", "right at once", "typed error, then right", "violated")
    for fault in faults:
        counts = [seen[fault.__name__, word] for word in ("right", "typed error", "violated")]
        table.add_row(fault.__name__, *map(str, (sum(counts), *counts)))
    Console().print(table)
    for line in wrong:
        print(line)
    return len(wrong)


def main() -> int:
    """The exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, small_disk(Path(folder) / "disk") as mounted:
        if not mounted:
            print("no disk could be mounted here; full and read-only ones are left out", file=sys.stderr)
        box = Sandbox(Path(folder) / "disk")
        for name in ANSWERS:
            for kind in ("build", "solve", "import"):
                found = box.timed(kind, name)
                if found != "right":
                    print(f"{kind} of {name} without any fault: {found}")
                    return 1
        return 1 if rounds(box, MOUNTED if mounted else ANYWHERE, given.count, given.seed) else 0


if __name__ == "__main__":
    sys.exit(main())
