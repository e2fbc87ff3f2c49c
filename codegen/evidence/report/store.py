"""The extent of a report, the cases that it measures, and the store of measured values.

The store is a file with one JSON object per line. A case that the store contains is not measured again.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np

from codegen.problem.points import PointSet, read_points
from codegen.solving.compiler import build
from codegen.solving.loading import ConnectModule, load

Values = Mapping[str, Any]


@dataclass(frozen=True)
class Case:
    """A measurement: a section of the store, a name that is unique in the section, and the function that measures."""

    section: str
    name: str
    measure: Callable[[], Values]


def section_of(problem: Path, part: str) -> str:
    """Return the name of a section of the store: the problem and a part, such as "optima", "errors" or "orders"."""
    return f"{problem.stem}: {part}"


class Store:
    """The measured values of all cases, kept in a file of JSON lines; cases in damaged lines are measured again."""

    def __init__(self, path: Path) -> None:
        """Read the file if it exists."""
        self.path, self._values = path, dict[tuple[str, str], Values]()
        if path.is_file():
            for line in path.read_text(encoding="utf-8").splitlines():
                try:
                    row = json.loads(line)
                    self._values[row["section"], row["case"]] = row["values"]
                except (ValueError, KeyError, TypeError):
                    continue  # a run was killed while it wrote this line

    def measured(self, case: Case) -> bool:
        """Measure and store a case unless the store contains it; return True if it was measured."""
        if (case.section, case.name) in self._values:
            return False
        values = {key: _plain(value) for key, value in case.measure().items()}
        self._values[case.section, case.name] = values
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"section": case.section, "case": case.name, "values": values}) + "\n")
            file.flush()
            os.fsync(file.fileno())
        return True

    def get(self, section: str, name: str) -> Values | None:
        """Return the values of a case, or None if the case was not measured."""
        return self._values.get((section, name))

    def rows(self, section: str) -> Iterator[tuple[str, Values]]:
        """Yield the names and values of the cases of a section, in the order of measurement."""
        yield from ((name, values) for (part, name), values in self._values.items() if part == section)

    def table(self) -> str:
        """Return all values as CSV text: section, case, quantity, value; arrays have one row for each entry."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["section", "case", "quantity", "value"])
        for (section, name), values in self._values.items():
            for quantity, value in values.items():
                writer.writerows([section, name, key, number] for key, number in _entries(quantity, value))
        return text.getvalue()


def _entries(quantity: str, value: object) -> Iterator[tuple[str, object]]:
    if isinstance(value, dict):
        for name, entry in value.items():
            yield from _entries(f"{quantity}.{name}", entry)
    elif isinstance(value, list):
        for index, entry in enumerate(value):
            yield from _entries(f"{quantity}[{index}]", entry)
    else:
        yield quantity, "" if value is None else value


def _plain(value: object) -> object:
    """Return a value in the types of JSON: arrays become lists, and numbers that are not finite become null."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@dataclass(frozen=True)
class Extent:
    """The limits of a report on problems.

    Numbers of steps are doubled `simulation_doublings` or `control_doublings` times, but not after a solve of more
    than `limit` seconds. A solve is repeated for at most `time_budget` seconds (see building.py). A simulation is
    measured with at most `most_simulated` schemes. A control problem is measured with at most `most_schemes` schemes
    of order `most_order` or less, and with compositions of at most `most_parts` steps, since modules of schemes with
    many stages take long to build. With `only_default_of_phases` a problem with several phases has only the default
    scheme. The reference of an optimum takes about `reference_seconds` for each scheme that is tried. A mesh sequence,
    which measures the order of an optimum, starts no grid after `sequence_seconds`. The drivers are compared if there
    are at most `driver_unknowns` unknowns. The general form is built for modules with at most `general_operations`
    operations. The energy of a simulation is observed over `drift_steps` steps, or not at all for 0. Without `peers`,
    other programs are not measured.
    """

    quick: bool = False
    simulation_doublings: int = 14
    control_doublings: int = 7
    reference_seconds: float = 10.0
    sequence_seconds: float = 1.5
    most_schemes: int = 99
    most_simulated: int = 99
    most_order: int = 99
    most_parts: int = 5
    only_default_of_phases: bool = False
    limit: float = 0.5
    time_budget: float = 0.5
    driver_unknowns: int = 300
    general_operations: int = 100_000
    drift_steps: int = 1_000_000
    peers: bool = True


FULL = Extent()  # the extent of a report on a single problem
GALLERY = Extent(
    control_doublings=4, reference_seconds=2.0, sequence_seconds=10.0, most_schemes=2, most_order=2,
    only_default_of_phases=True, most_simulated=8, limit=1.0, time_budget=0.3, driver_unknowns=150,
    general_operations=60, drift_steps=0, peers=False,
)  # fmt: skip
"""The extent of a report on a folder of problems, which takes less than 20 minutes on two processors."""
QUICK = Extent(
    quick=True, simulation_doublings=7, control_doublings=7, reference_seconds=3.0, sequence_seconds=1.0,
    most_schemes=4, most_order=4, most_simulated=4, limit=0.5, time_budget=0.2, driver_unknowns=0,
    general_operations=0, drift_steps=0, peers=False,
)  # fmt: skip
"""The extent of a report in continuous integration."""
QUICK_PROBLEMS = ("pendulum", "linear_pendulum")  # the problems of a folder that a quick report measures
NODES = tuple(range(10, 101, 5))  # the numbers of steps in the thesis: 10, 15, ..., 100


@dataclass(frozen=True)
class Settings:
    """The extent of the study of landmark registration.

    `counts` are the sizes of the small sets of landmarks, `steps` the numbers of time steps. A route of solution stops
    at the first number of steps with a solve of more than `limit` seconds.
    """

    problem: Path
    counts: tuple[int, ...] = (3, 4, 5)
    steps: tuple[int, ...] = NODES
    limit: float = 1.0
    quick: bool = False

    @property
    def landmarks(self) -> PointSet:
        """Return the 40 landmarks of two trilobites, from the data next to the problem file."""
        return read_points(self.problem.parent / "data" / "trilobite40.csv", 2)

    def points(self, count: int) -> PointSet:
        """Return the landmarks of the trilobites if `count` is 40, else `count` random landmarks."""
        return self.landmarks if count == 40 else few_landmarks(count)

    def module(self, scheme: str, method: str | None = None, **arguments: str) -> ConnectModule:
        """Return the generated module of a scheme and a method, with `arguments` of problem()."""
        return _module(self.problem, scheme, method, tuple(sorted(arguments.items())))


@cache
def _module(path: Path, scheme: str, method: str | None, arguments: tuple[tuple[str, str], ...]) -> ConnectModule:
    return cast(ConnectModule, load(build(path, dict(arguments), scheme=scheme, method=method).path))


def quick_settings(problem: Path) -> Settings:
    """Return the settings of a study of less than a minute: one set of landmarks, three grids, the fast routes."""
    return Settings(problem, (3,), (10, 20, 40), 2.0, quick=True)


def few_landmarks(count: int) -> PointSet:
    """Return random landmarks as in the thesis (E.3.6), from numpy's generator with `count` as its seed.

    With U uniform in [0, 1), radii are r0 and r1 = r0 + 0.1 U, angles a0 = 2 pi U and a1 = a0 + 0.1 pi U. Radii of 0.9
    and more are reduced by 0.4. Matlab's `rand('state', nc)` is not available, so the thesis has other points.
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


def smooth_pair(count: int, dimension: int = 2) -> PointSet:
    """Return random points of the disc or ball of radius 0.9, and their images under a smooth displacement."""
    generator = np.random.default_rng(1)
    direction = generator.normal(size=(count, dimension))
    radius = 0.9 * generator.random(count) ** (1.0 / dimension)
    start = radius[:, None] * direction / np.linalg.norm(direction, axis=1)[:, None]
    shift = np.stack([np.sin(2.0 * start[:, (a + 1) % dimension] + 0.3 * a) for a in range(dimension)], axis=1)
    return PointSet(start, start + 0.12 * ((1.0 - radius**2) ** 2)[:, None] * shift, np.zeros(count))
