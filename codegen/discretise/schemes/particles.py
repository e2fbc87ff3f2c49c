"""Schemes for many particles: those that families offer for them, and compositions of higher order."""

from __future__ import annotations

import difflib

from codegen.discretise import schemes
from codegen.discretise.schemes.base import PARTICLES, Scheme
from codegen.errors import SchemeError

PARTICLE_SCHEMES: dict[str, Scheme] = {scheme.name: scheme for scheme in schemes.of_method(PARTICLES)}
"""Schemes for pairwise systems by name, over which tests run; `find` knows the compositions of higher order as well."""


def find(name: str, task: str) -> Scheme:
    """The scheme of that name; SchemeError tells which there are for the task."""
    offered = [n for n, s in PARTICLE_SCHEMES.items() if task == "connect" or not s.adaptive]
    found = PARTICLE_SCHEMES.get(name) if name in offered else None
    if found is None and (
        "-of-" in name or (schemes.is_known(name, "hamiltonian") and bool(schemes.find(name, "hamiltonian").parts))
    ):
        found = schemes.find(name, "hamiltonian")
    if found is None:
        close = difflib.get_close_matches(name, offered, 1)
        hint = f"did you mean {close[0]}?" if close else f"use one of {', '.join(offered)}"
        raise SchemeError(f"there is no scheme {name!r} for particles and task {task}", hint)
    return found
