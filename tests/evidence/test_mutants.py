"""Defects in the reading of a problem are planted, and found by the comparison with the author's problem."""

from __future__ import annotations

import pytest
from mutated_package import MUTANTS, Outcome, outcomes

NAME = "problem as written"
FOUND = {
    "the sign of a force flipped": "equations of motion: q is",
    "the cost times two": "cost: cost is",
    "end values 1 % larger": "values at the end: q is 1.25663706 as written, 1.26920343 in the module",
    "the duration times two": "duration: T is 1.57079633 as written, 3.14159265 in the module",
    "the sign of the Lagrangian": "equations of motion: q is",
    "the cost halved": "cost: cost is",
    "upper bounds dropped": "bounds: upper bound of u is",
    "the start of a simulation 1 % off": "values at the start: p is 1.4 as written, 1.414 in the module",
}
"""What the comparison says about some defects; no other check finds them."""


@pytest.fixture(scope="module")
def found() -> dict[str, Outcome]:
    numbers = [number for number, mutant in enumerate(MUTANTS) if mutant.what in FOUND]
    return {MUTANTS[n].what: each for n, each in zip(numbers, outcomes(numbers, (NAME,)), strict=True)}


@pytest.mark.parametrize("what", FOUND)
def test_defects_of_reading_are_found(found, what):
    assert found[what].caught_by == NAME
    assert found[what].text.startswith(FOUND[what])


@pytest.mark.fast
def test_every_defect_fits_the_sources():
    """A defect replaces a text that its file has, by another one; each is described once for its problem."""
    for mutant in MUTANTS:
        text = mutant.path.read_text(encoding="utf-8")
        assert mutant.old in text, mutant
        compile(text.replace(mutant.old, mutant.new, 1), mutant.file, "exec")
    assert len({(mutant.what, mutant.problem) for mutant in MUTANTS}) == len(MUTANTS) >= 40
