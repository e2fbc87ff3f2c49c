"""The committed generated modules: which there are, whether they are what the generator makes today, and --update.

`python tests/golden.py` compares the folder `generated/` as a set of files, byte by byte, with a fresh generation and
prints a unified diff of what differs; `--update` rewrites it.
"""

from __future__ import annotations

import difflib
import sys
from collections.abc import Collection
from pathlib import Path

from codegen.compiler import generate
from codegen.emit import write
from codegen.naming import Choices, module_name

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "generated"

CONTROL = (
    "acrobot betts_10_7 bouncing_ball brachistochrone bryson_denham cart_pendulum cart_pole convoy crane "
    "double_integrator double_integrator_effort four_bar goddard_rocket hovercraft hypersensitive low_thrust "
    "n_link_pendulum pendulum_swing_up quadrotor robot_arm spherical_pendulum two_link_arm two_stage_rocket van_der_pol"
).split()

GALLERY = (
    ("linear_pendulum", {}, Choices()),
    ("orbital_transfer", {}, Choices()),
    ("orbital_transfer", {}, Choices(method="hamiltonian")),
    ("pendulum", {}, Choices()),
    ("pendulum", {}, Choices(scheme="stormer-verlet")),
    ("pendulum", {"form": "lagrangian"}, Choices()),
    *((problem, {}, Choices()) for problem in CONTROL),
    ("image_registration", {}, Choices()),
    ("image_registration", {}, Choices(scheme="explicit-euler")),
    ("lennard_jones", {}, Choices(scheme="stormer-verlet")),
    ("outer_solar_system", {}, Choices(scheme="stormer-verlet")),
)
"""Problem, arguments and choices of every committed module."""


def names(problems: Collection[str] | None = None) -> set[str]:
    """File names of all modules of the gallery, or of those of some problems."""
    return {
        f"{module_name(ROOT / 'problems' / f'{problem}.py', arguments, choices)}.py"
        for problem, arguments, choices in GALLERY
        if problems is None or problem in problems
    }


def fresh(problems: Collection[str] | None = None) -> dict[str, str]:
    """File name -> text of every module of the gallery, or of some problems, generated anew."""
    texts = {}
    for problem, arguments, choices in GALLERY:
        if problems is not None and problem not in problems:
            continue
        path = ROOT / "problems" / f"{problem}.py"
        texts[f"{module_name(path, arguments, choices)}.py"] = generate(path, arguments, choices)
    return texts


def of_problems(problems: Collection[str]) -> dict[str, str]:
    """File name -> text of the committed modules of some problems."""
    return {name: text for name, text in committed().items() if name in names(problems)}


def committed() -> dict[str, str]:
    """File name -> text of every module in the folder."""
    return {path.name: path.read_text(encoding="utf-8") for path in sorted(FOLDER.glob("*.py"))}


def differences(old: dict[str, str], new: dict[str, str]) -> list[str]:
    """Lines that tell how two sets of files differ; empty when they are the same."""
    lines = [f"missing: {name}" for name in sorted(new.keys() - old.keys())]
    lines += [f"not made by the generator: {name}" for name in sorted(old.keys() - new.keys())]
    for name in sorted(old.keys() & new.keys()):
        lines += difflib.unified_diff(
            old[name].splitlines(), new[name].splitlines(), f"generated/{name}", f"generated anew/{name}", lineterm=""
        )
    return lines


def main() -> int:
    """Compare, or rewrite with --update; exit status 1 when the folder is not what the generator makes."""
    texts = fresh()
    if "--update" in sys.argv[1:]:
        for name in committed().keys() - texts.keys():
            (FOLDER / name).unlink()
        for name, text in texts.items():
            write(FOLDER / name, text)
        return 0
    lines = differences(committed(), texts)
    print("\n".join(lines) if lines else f"{len(texts)} generated modules are up to date")
    return bool(lines)


if __name__ == "__main__":
    sys.exit(main())
