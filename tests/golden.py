"""The generated modules of the gallery: those that are committed, digests of the others, comparison and --update.

Committed are the problems with which the project began and a module for every kind of feature, since a change of
emission should be read; of the others, whose numerics are the same text, `generated/digests.txt` holds a digest each.
`python tests/golden.py` compares all of them with a fresh generation and prints what differs; `--update` rewrites the
folder.
"""

from __future__ import annotations

import argparse
import difflib
import hashlib
import sys
from collections.abc import Collection, Mapping
from dataclasses import asdict
from functools import cache
from pathlib import Path

from codegen.emit.naming import Choices, module_name
from codegen.emit.rendering import write
from codegen.solving.compiler import build, generate

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "generated"
DIGESTS = FOLDER / "digests.txt"

KEPT = (
    "bouncing_ball hovercraft image_registration lennard_jones_stormer_verlet linear_pendulum"
    " orbital_transfer pendulum spherical_pendulum"
).split()
"""Modules that are committed.

Their features: phases; a free duration, and with it bounds; several bodies; first-order dynamics; particles that are
connected, and that are simulated; a linear-quadratic problem; steps that are explicit or implicit; holonomic
constraints.
"""

_WITH_CHOICES = (
    ("linear_pendulum", {}, Choices()),
    ("orbital_transfer", {}, Choices()),
    ("orbital_transfer", {}, Choices(method="hamiltonian")),
    ("pendulum", {}, Choices()),
    ("pendulum", {}, Choices(scheme="stormer-verlet")),
    ("pendulum", {"form": "lagrangian"}, Choices()),
    ("image_registration", {}, Choices()),
    ("image_registration", {}, Choices(scheme="explicit-euler")),
    ("image_registration", {"passive": "True", "dimension": "3"}, Choices()),
    ("lennard_jones", {}, Choices(scheme="stormer-verlet")),
    ("outer_solar_system", {}, Choices(scheme="stormer-verlet")),
)
_OTHERS = [
    path
    for path in sorted((ROOT / "problems").glob("*.py"))
    if path.stem not in {problem for problem, _, _ in _WITH_CHOICES}
]
CONTROL = tuple(path.stem for path in _OTHERS if "Control(" in path.read_text(encoding="utf-8"))
"""Problems of control whose modules are those of default choices alone."""

GALLERY = (*_WITH_CHOICES, *((path.stem, {}, Choices()) for path in _OTHERS))
"""Problem, arguments and choices of every module."""


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


def built(problems: Collection[str]) -> dict[str, str]:
    """The same of some problems by the build cache, whose keys hold all of the generator's text, for tests to share."""
    texts = {}
    for problem, arguments, choices in GALLERY:
        if problem in problems:
            path = build(ROOT / "problems" / f"{problem}.py", arguments, **asdict(choices)).path
            texts[path.name] = path.read_text(encoding="utf-8")
    return texts


@cache
def text_of(name: str) -> str:
    """The text of a module of the gallery by its file name; where it is not committed, the build cache has it."""
    path = FOLDER / name
    if not path.is_file():
        path = next(
            build(ROOT / "problems" / f"{problem}.py", arguments, **asdict(choices)).path
            for problem, arguments, choices in GALLERY
            if name == f"{module_name(ROOT / 'problems' / f'{problem}.py', arguments, choices)}.py"
        )
    return path.read_text(encoding="utf-8")


def committed() -> dict[str, str]:
    """File name -> text of every module in the folder."""
    return {path.name: path.read_text(encoding="utf-8") for path in sorted(FOLDER.glob("*.py"))}


def digests() -> dict[str, str]:
    """File name -> digest of every module that is not committed."""
    return {name: digest for digest, name in (line.split() for line in DIGESTS.read_text().splitlines())}


def digest_of(text: str) -> str:
    """The SHA-256 of a text, in hexadecimal."""
    return hashlib.sha256(text.encode()).hexdigest()


def differences(new: Mapping[str, str], problems: Collection[str] | None = None) -> list[str]:
    """Lines that tell how modules differ from what is on record, of some problems or of all; empty where they agree."""
    wanted = names(problems)
    old = {name: text for name, text in committed().items() if name in wanted or problems is None}
    known = {name: digest for name, digest in digests().items() if name in wanted or problems is None}
    lines = [f"missing: {name}" for name in sorted(new.keys() - old.keys() - known.keys())]
    lines += [f"not made by the generator: {name}" for name in sorted((old.keys() | known.keys()) - new.keys())]
    for name in sorted(old.keys() & new.keys()):
        lines += difflib.unified_diff(
            old[name].splitlines(), new[name].splitlines(), f"generated/{name}", f"generated anew/{name}", lineterm=""
        )
    lines += [f"differs: {name}" for name in sorted(known.keys() & new.keys()) if known[name] != digest_of(new[name])]
    return lines


def update(texts: Mapping[str, str]) -> None:
    """Write the modules that are kept, and the digests of the others."""
    kept = {f"{name}.py" for name in KEPT}
    for name in committed().keys() - kept:
        (FOLDER / name).unlink()
    for name in kept:
        write(FOLDER / name, texts[name])
    write(DIGESTS, "".join(f"{digest_of(texts[name])}  {name}\n" for name in sorted(texts.keys() - kept)))


def main() -> int:
    """Compare, or rewrite with --update; exit status 1 when the folder is not what the generator makes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--update", action="store_true", help="write generated/ anew")
    arguments = parser.parse_args()
    texts = fresh()
    if arguments.update:
        update(texts)
        return 0
    lines = differences(texts)
    print("\n".join(lines) if lines else f"{len(texts)} generated modules are up to date")
    return bool(lines)


if __name__ == "__main__":
    sys.exit(main())
