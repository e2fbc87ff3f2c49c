"""Three landmarks, and the schemes of fixed steps that connect them."""

from __future__ import annotations

import numpy as np

from codegen.discretise.particles import PARTICLE_SCHEMES
from codegen.problem.points import PointSet

START = np.array([[0.1, 0.2], [-0.4, 0.1], [0.3, -0.5]])


TARGET = START + np.array([[0.12, -0.05], [0.03, 0.1], [-0.08, 0.04]])


STEPS = [name for name, scheme in PARTICLE_SCHEMES.items() if not scheme.adaptive]


def few(sigma=0.0):
    return PointSet(START, TARGET, np.full(3, sigma))
