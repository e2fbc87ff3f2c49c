"""The extent of a report, and the settings of the study of landmark registration with the points that it connects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import cast

import numpy as np

from codegen.problem.points import PointSet, read_points
from codegen.solving.compiler import build
from codegen.solving.loading import ConnectModule, load

NODES = tuple(range(10, 101, 5))
"""The thesis's numbers of steps, 10:5:100."""


@dataclass(frozen=True)
class Settings:
    """The extent of a study: the problem file, sets of few landmarks, numbers of steps, seconds for a single solve."""

    problem: Path
    counts: tuple[int, ...] = (3, 4, 5)
    steps: tuple[int, ...] = NODES
    limit: float = 20.0
    quick: bool = False

    @property
    def landmarks(self) -> PointSet:
        """The 40 landmarks of two trilobites that lie beside the problem."""
        return read_points(self.problem.parent / "data" / "trilobite40.csv", 2)

    def module(self, scheme: str, method: str | None = None, **arguments: str) -> ConnectModule:
        """The generated module of a scheme and a method."""
        return _module(self.problem, scheme, method, tuple(sorted(arguments.items())))


@cache
def _module(path: Path, scheme: str, method: str | None, arguments: tuple[tuple[str, str], ...]) -> ConnectModule:
    given: Mapping[str, str] = dict(arguments)
    return cast(ConnectModule, load(build(path, given, scheme=scheme, method=method).path))


def quick_settings(problem: Path) -> Settings:
    """A study that takes less than a minute: one set of landmarks, three numbers of steps, the fast routes."""
    return Settings(problem, (3,), (10, 20, 40), 2.0, quick=True)


def few_landmarks(count: int) -> PointSet:
    """The thesis's random landmarks (E.3.6), from numpy's generator with the number of landmarks as its seed.

    Radii r0 and r1 = r0 + 0.1 U, angles a0 = 2 pi U and a1 = a0 + 0.1 pi U, where radii of 0.9 and more are reduced by
    0.4. Matlab's `rand('state', nc)` is not available, so the points differ from the thesis's.
    """
    generator = np.random.default_rng(count)

    def inside(radius: np.ndarray) -> np.ndarray:
        return np.where(radius >= 0.9, radius - 0.4, radius)

    first = inside(generator.random(count))
    second = inside(first + 0.1 * generator.random(count))
    angle = 2.0 * np.pi * generator.random(count)
    turned = angle + 0.1 * np.pi * generator.random(count)
    start, target = (np.stack([r * np.cos(a), r * np.sin(a)], axis=1) for r, a in ((first, angle), (second, turned)))
    return PointSet(start, target, np.zeros(count))


def smooth_pair(count: int, dimension: int = 2, seed: int = 1) -> PointSet:
    """Random points of the disc or ball of radius 0.9 and where a smooth displacement carries them."""
    generator = np.random.default_rng(seed)
    way = generator.normal(size=(count, dimension))
    radius = 0.9 * generator.random(count) ** (1.0 / dimension)
    start = radius[:, None] * way / np.linalg.norm(way, axis=1)[:, None]
    shift = np.stack([np.sin(2.0 * start[:, (a + 1) % dimension] + 0.3 * a) for a in range(dimension)], axis=1)
    return PointSet(start, start + 0.12 * ((1.0 - radius**2) ** 2)[:, None] * shift, np.zeros(count))


@dataclass(frozen=True)
class Extent:
    """Limits: doublings of the number of steps, schemes per control problem, seconds of a solve, repetitions.

    A ladder of steps is taken no further once a solve takes more than `limit` seconds; the mesh sequence in which
    orders of optima are measured begins no grid after `sequence_seconds`; drivers of scipy are only asked
    where there are at most `driver_unknowns` unknowns. At most `most_schemes` schemes of a control problem count,
    and `most_simulated` of a simulation; those of a control problem have at most the order `most_order`, since modules
    of schemes with many stages take long to make, and with `only_default_of_phases` several phases have one scheme.
    The general form, which leaves nothing out, is made of modules of up to `general_operations` operations.
    The energy of a simulation is followed over `drift_steps` steps, where these are not zero.
    """

    quick: bool = False
    simulation_doublings: int = 12
    control_doublings: int = 4
    sequence_seconds: float = 30.0
    most_schemes: int = 10
    most_simulated: int = 99
    most_order: int = 6
    only_default_of_phases: bool = False
    limit: float = 2.0
    repeat: int = 3
    driver_unknowns: int = 300
    general_operations: int = 100_000
    drift_steps: int = 1_000_000


FULL = Extent()
"""One problem with all schemes."""
GALLERY = Extent(
    control_doublings=3,
    sequence_seconds=10.0,
    most_schemes=2,
    most_order=2,
    only_default_of_phases=True,
    most_simulated=8,
    limit=1.0,
    repeat=2,
    driver_unknowns=150,
    general_operations=60,
    drift_steps=0,
)
"""A folder of problems in less than 20 minutes on two processors."""
QUICK = Extent(
    quick=True,
    simulation_doublings=5,
    control_doublings=3,
    sequence_seconds=2.0,
    most_schemes=2,
    most_order=2,
    most_simulated=4,
    limit=0.5,
    repeat=1,
    driver_unknowns=0,
    general_operations=0,
    drift_steps=0,
)
"""What continuous integration can afford."""
QUICK_PROBLEMS = ("pendulum", "linear_pendulum")
"""Of a folder, these are measured in the quick form."""
