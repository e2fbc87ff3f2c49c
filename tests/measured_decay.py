"""A decay that was measured, as a problem file, and its modules run by the interpreter."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from interpreted import without_compilation

from codegen.solving.compiler import build

DECAY = '''"""A substance decays; how fast, and how much was there?"""

from codegen import Control, Measurements, free_parameter, states


def problem() -> Control:
    (x,) = states("x")
    k, x_0 = free_parameter("k", 1, lower=0.01), free_parameter("x_0", 1)
    return Control(
        dynamics={{x: -k * x}},
        observations=Measurements("decay.csv", values={{x: "z"}}{options}),
        duration=3,
        start={{x: x_0}},
        steps=30,
    )
'''
TIMES = np.array([0.0, 0.11, 0.3, 0.3, 0.52, 0.9, 1.4, 1.77, 2.2, 2.9, 3.0])
NOISE = np.array([0.03, -0.02, 0.05, -0.04, 0.01, -0.03, 0.02, 0.04, -0.01, -0.02, 0.03])
VALUES = 2.0 * np.exp(-0.8 * TIMES) + NOISE


def write(folder: Path, name: str, **columns: np.ndarray) -> Path:
    """A file of columns, with empty cells for NaN."""
    rows = zip(*columns.values(), strict=True)
    lines = [",".join("" if np.isnan(value) else repr(float(value)) for value in row) for row in rows]
    path = folder / name
    path.write_text("\n".join([",".join(columns), *lines]) + "\n")
    return path


def write_decay(folder: Path, options: str = "", **columns: np.ndarray) -> Path:
    write(folder, "decay.csv", **(columns or {"t": TIMES, "z": VALUES}))
    path = folder / "decay.py"
    path.write_text(DECAY.format(options=options))
    return path


def interpreted(path: Path, **choices: str):
    return without_compilation(build(path, **choices).path.read_text())


def decay(t, k, x_0):
    return x_0 * np.exp(-k * t)
