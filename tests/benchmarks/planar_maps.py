"""What the benchmarks of registration share: landmarks in pixels, determinants by differences, a console."""

from collections.abc import Callable
from typing import Any

import numpy as np
from rich.console import Console

from codegen.problem.points import PointSet
from codegen.registration.pairs import LandmarkPairs

CONSOLE = Console(width=130)


def in_pixels(points: PointSet, side: int) -> LandmarkPairs:
    """Landmarks of the disc in the middle of a square image, whose edges are at 0.85 of its radius."""
    middle, scale = (side - 1) / 2, side / 1.7
    return LandmarkPairs(middle + scale * points.start, middle + scale * points.target)


def determinants_by_differences(function: Callable[[Any], Any], points: Any, step: float = 1e-3) -> Any:
    """The determinant of a map's derivative at points, from central differences."""
    columns = [(function(points + d) - function(points - d)) / (2.0 * step) for d in step * np.eye(2)]
    return np.linalg.det(np.stack(columns, axis=-1))
