"""Mechanical systems for tests of simulations: as problems in sympy, and once more by hand as functions of numbers."""

from __future__ import annotations

import hashlib
import importlib.util
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import mpmath
import sympy
from interpreted import without_compilation

from codegen.discretise.model.definitions import Model
from codegen.discretise.model.from_problem import load_problem, normalise
from codegen.emit import naming
from codegen.emit.lower.module import Origin
from codegen.problem.problem import Simulate
from codegen.problem.symbols import (
    canonical_pair,
    canonical_pairs,
    coordinate,
    coordinates,
    parameter,
    parameters,
    time,
)
from codegen.solving import compiler

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class System:
    """A model, and by hand in mpmath: L(q, v, t), H(q, p, t), force(q, v, t); a state away from symmetries."""

    name: str
    model: Callable[[], Model]
    lagrangian: Callable[..., Any]
    hamiltonian: Callable[..., Any]
    state: tuple[float, ...]
    force: Callable[..., Any] | None = None

    @property
    def dimension(self) -> int:
        return len(self.state) // 2


def pendulum(form: str = "hamiltonian") -> Model:
    return load_problem(ROOT / "problems" / "pendulum.py", {"form": form})


def double_pendulum() -> Model:
    (a, b), (da, db) = coordinates("a b")
    m, g = parameters(m=2, g=9)
    kinetic = m * (da**2 + db**2 / 2 + da * db * sympy.cos(a - b))
    potential = -m * g * (2 * sympy.cos(a) + sympy.cos(b))
    problem = Simulate(lagrangian=kinetic - potential, duration=10, start={a: 1, b: 2, da: 0, db: 0.5})
    return normalise(problem, name="double_pendulum")


def kepler() -> Model:
    (r, phi), (pr, pphi) = canonical_pairs("r phi", "pr pphi")
    GM = parameter("GM", 1.5)
    problem = Simulate(
        hamiltonian=(pr**2 + pphi**2 / r**2) / 2 - GM / r, duration=10, start={r: 1, phi: 0, pr: 0.1, pphi: 1.2}
    )
    return normalise(problem, name="kepler")


def coupled(friction: float = 0.1) -> Model:
    """Two coordinates with a constant mass matrix that is not diagonal, one nonlinear force and one friction."""
    (a, b), (da, db) = coordinates("a b")
    m, k, c = parameters(m=2, k=1.5, c=friction)
    kinetic = m * da**2 / 2 + m * da * db / 2 + db**2 / 2 * m
    problem = Simulate(
        lagrangian=kinetic - k * (a - b) ** 2 / 2 + sympy.cos(a),
        force={a: -c * da},
        duration=10,
        start={a: 1, b: 2, da: 0, db: 0},
    )
    return normalise(problem, name="coupled")


def driven() -> Model:
    q, dq = coordinate("q")
    t = time()
    problem = Simulate(
        lagrangian=dq**2 / 2 + (1 + sympy.cos(3 * t) / 2) * sympy.cos(q),
        force={q: sympy.sin(2 * t)},
        duration=10,
        start={q: 0.3, dq: 0},
    )
    return normalise(problem, name="driven")


def chain(count: int) -> Model:
    """Springs between all pairs of masses: a linear system with a full stiffness matrix."""
    q, v = coordinates(" ".join(f"q{i}" for i in range(count)))
    k = parameter("k", 0.7)
    kinetic = sum((i + 1) * v[i] ** 2 / 2 for i in range(count))
    springs = sum((q[i] - q[j]) ** 2 * (i + j) / 2 for i in range(count) for j in range(i))
    start = {q[i]: sympy.sin(i + 1) for i in range(count)} | dict.fromkeys(v, 0)
    return normalise(Simulate(lagrangian=kinetic - k * springs, duration=5, start=start), name="chain")


def rough_plane() -> Model:
    """A particle in the plane whose friction depends on the place and couples both directions."""
    (a, b), (da, db) = coordinates("a b")
    problem = Simulate(
        lagrangian=(da**2 + db**2) / 2,
        force={a: -(1 + a**2) * (2 * da + db), b: -(1 + b**2) * (da + 3 * db)},
        duration=10,
        start={a: 0.4, b: 0.3, da: 0.7, db: -0.2},
    )
    return normalise(problem, name="rough_plane")


def falling_root() -> Model:
    """A potential sqrt(q), whose force is not real once q has become negative."""
    q, p = canonical_pair("q", "p")
    return normalise(Simulate(hamiltonian=p**2 / 2 + sympy.sqrt(q), duration=10, start={q: 1, p: 0}), name="root")


def escape() -> Model:
    """A particle that escapes to infinity: q'' = q^2. A midpoint step h > 1 from (1, 0) has no real solution."""
    q, p = canonical_pair("q", "p")
    return normalise(Simulate(hamiltonian=p**2 / 2 - q**3 / 3, duration=10, start={q: 1, p: 0}), name="escape")


def _double_pendulum_hamiltonian(q: Any, p: Any, t: Any) -> Any:
    m, g = 2, 9
    c = mpmath.cos(q[0] - q[1])
    kinetic = (p[0] ** 2 - 2 * c * p[0] * p[1] + 2 * p[1] ** 2) / (2 * m * (2 - c**2))
    return kinetic - m * g * (2 * mpmath.cos(q[0]) + mpmath.cos(q[1]))


def _coupled_hamiltonian(q: Any, p: Any, t: Any) -> Any:
    m, k = 2, mpmath.mpf("1.5")
    kinetic = (p[0] ** 2 - p[0] * p[1] + p[1] ** 2) * 2 / (3 * m)
    return kinetic + k * (q[0] - q[1]) ** 2 / 2 - mpmath.cos(q[0])


H, T = 0.1, 0.7
"""Step and time of single steps that are checked."""

SYSTEMS = {
    system.name: system
    for system in (
        System(
            "pendulum-hamiltonian",
            pendulum,
            lambda q, v, t: v[0] ** 2 / 2 + mpmath.cos(q[0]),
            lambda q, p, t: p[0] ** 2 / 2 - mpmath.cos(q[0]),
            (0.7, 1.1),
        ),
        System(
            "pendulum-lagrangian",
            lambda: pendulum("lagrangian"),
            lambda q, v, t: v[0] ** 2 / 2 + mpmath.cos(q[0]),
            lambda q, p, t: p[0] ** 2 / 2 - mpmath.cos(q[0]),
            (0.7, 1.1),
        ),
        System(
            "double-pendulum",
            double_pendulum,
            lambda q, v, t: (
                2 * (v[0] ** 2 + v[1] ** 2 / 2 + v[0] * v[1] * mpmath.cos(q[0] - q[1]))
                + 18 * (2 * mpmath.cos(q[0]) + mpmath.cos(q[1]))
            ),
            _double_pendulum_hamiltonian,
            (0.7, 1.1, 2.0, -1.0),
        ),
        System(
            "kepler",
            kepler,
            lambda q, v, t: (v[0] ** 2 + q[0] ** 2 * v[1] ** 2) / 2 + mpmath.mpf("1.5") / q[0],
            lambda q, p, t: (p[0] ** 2 + p[1] ** 2 / q[0] ** 2) / 2 - mpmath.mpf("1.5") / q[0],
            (1.3, 0.4, 0.2, 1.1),
        ),
        System(
            "coupled",
            coupled,
            lambda q, v, t: (
                v[0] ** 2 + v[0] * v[1] + v[1] ** 2 - mpmath.mpf("0.75") * (q[0] - q[1]) ** 2 + mpmath.cos(q[0])
            ),
            _coupled_hamiltonian,
            (1.3, 0.4, 0.2, 1.1),
            lambda q, v, t: (-v[0] / 10, 0),
        ),
        System(
            "driven",
            driven,
            lambda q, v, t: v[0] ** 2 / 2 + (1 + mpmath.cos(3 * t) / 2) * mpmath.cos(q[0]),
            lambda q, p, t: p[0] ** 2 / 2 - (1 + mpmath.cos(3 * t) / 2) * mpmath.cos(q[0]),
            (0.7, 1.1),
            lambda q, v, t: (mpmath.sin(2 * t),),
        ),
    )
}


def text_of(model: Model, scheme: str, method: str) -> str:
    inputs = hashlib.sha256(repr((model, scheme, method)).encode()).hexdigest()
    origin = Origin(f"{model.name}.py", "codegen build", inputs, ("codegen",))
    return compiler.generate_from_model(model, naming.Choices(scheme, method), origin)


@cache
def model_of(system: str) -> Any:
    return SYSTEMS[system].model()


@cache
def module_of(system: str, method: str, scheme: str) -> Any:
    return without_compilation(text_of(model_of(system), scheme, method))


def compiled(text: str, folder: Path, name: str) -> ModuleType:
    """Import a generated module from a file in the folder."""
    file = folder / f"{name}.py"
    file.write_text(text, encoding="utf-8")
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module
