"""What a study of landmark registration runs over, and the points that it connects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import cast

import numpy as np

from codegen.author.points import PointSet, read_points
from codegen.compiler import build
from codegen.interfaces import ConnectModule
from codegen.loading import load

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
