"""The registry of families of stress cases; a new family is one file and one line here."""

from __future__ import annotations

from codegen.evidence.stress.cases import Case
from codegen.evidence.stress.families import control, motions, particles

FAMILIES = {
    "stiff": motions.stiff_cases,
    "orbits": motions.orbits_cases,
    "chaos": motions.chaos_cases,
    "horizons": motions.horizons_cases,
    "higher order": motions.higher_order_cases,
    "control": control.cases,
    "particles": particles.cases,
    "inputs": motions.inputs_cases,
}
"""Every family by name; tests run over this table."""

QUICK = (
    ("oscillator", "midpoint"),
    ("oscillator", "stormer-verlet"),
    ("oscillator", "explicit-euler"),
    ("kepler", "stormer-verlet"),
    ("linear_regulator", None),
    ("gravity", "stormer-verlet"),
)
"""Problem and scheme of the modules of a quick run."""


def all_cases() -> list[Case]:
    """Every case of every family."""
    return [case for family in FAMILIES.values() for case in family()]


def quick_cases() -> list[Case]:
    """Those of a few modules that are compiled soon."""
    return [
        case
        for case in all_cases()
        if (case.setup.file.stem, case.setup.scheme) in QUICK and case.setup.method != "variational"
    ]
