"""Results that nobody solved: first guesses of small problems, and invented modules with any number of quantities."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
from made_records import control_record
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from codegen.drawing import Arrow, Box, Circle, Ground, Mark, Mass, Rod, Scene, Trail
from codegen.runtime.record import Form, Kind, Meaning, Method
from codegen.solving.results.result import Result, component_names

BOUNDED = '''"""Push a cart between walls."""
from codegen import Control, control, coordinate
def problem():
    x, dx = coordinate("x")
    f = control("f")
    return Control(
        lagrangian=dx**2/2, force={x: f}, cost=f**2, duration=2, start={x: 0, dx: 0}, end={x: 1, dx: 0}, steps=4,
        bounds={x: (None, 1.5), f: (-1, 2)}, path=[f + x <= 3],
    )
'''

PAIR = '''"""Two runners who meet."""
from codegen import Control, body_number, control, coordinate
def problem():
    x, dx = coordinate("x")
    f, body = control("f"), body_number()
    return Control(
        lagrangian=dx**2/2, force={x: f}, cost=f**2, duration=1, start={x: body, dx: 0}, end={dx: 0}, bodies=2, steps=3,
        end_conditions=[x.of(0) - x.of(1)], bounds={f: (-5 - body, None)},
    )
'''


def unsolved(module: Any) -> Result:
    """The first guess of a module as a result."""
    grid = module.make_grid()
    unknowns = module.initial_guess(grid)
    t, q, p, u, multipliers = module.unpack(grid, unknowns)
    names = component_names(module.metadata)
    return Result(
        problem="made-up", title="Made up.", task="control", method=module.metadata.method, scheme="midpoint",
        driver="none", steps=grid.steps, status="stalled", message="", cost=1.0, residual=1.0, stationarity=1.0,
        iterations=0, t=t, q=q, p=p, u=u, multipliers=multipliers, energy=None, log=None, names=names,
        summary={}, unknowns=unknowns,
    )  # fmt: skip


def column(*values):
    return np.array(values, float)[:, None]


def invented(states: int, controls: int, bodies: int, form: str, conditions: int = 0) -> tuple[Any, Result]:
    """A module with only what figures read of it, and a result of 6 intervals."""
    steps, t = 6, np.linspace(0.0, 1.0, 7)
    wave = np.sin(3.0 * t[:, None] + np.arange(states * bodies))
    u = np.cos(3.0 * t[:-1, None] + np.arange(controls * bodies))
    names = tuple(f"x{i + 1}" for i in range(states))
    inputs = tuple(f"u{i + 1}" for i in range(controls))
    rates = () if form == "first-order" else tuple(f"dx{i + 1}" for i in range(states))
    mu, slacks = tuple(f"mu_{name}" for name in names), tuple(f"s_{i}" for i in range(conditions))
    y = tuple(f"y_{i}" for i in range(conditions))
    method = "one-step" if form == "first-order" else "variational"
    multipliers = wave[:-1] if form == "first-order" else wave
    momenta = wave[:, :0] if form == "first-order" else 1e-4 * wave
    unpacked = t, wave, momenta, u, multipliers
    limits = [
        (t, np.full_like(wave, sign * 0.9), np.full_like(wave, sign * np.inf), np.full_like(u, sign * 0.8), t)
        for sign in (-1, 1)
    ]
    interval = (*mu, *y, *inputs, *slacks)
    module = SimpleNamespace(
        metadata=control_record(
            method=Method(method), form=Form(form), bodies=bodies, coordinates=names, rates=rates,
            control_names=inputs, free_parameters=("T",), inequalities=True, node=names, interval=interval,
            meanings={s: Meaning(Kind.PATH_SLACK, f"x{i} + x1**2 <= {i}", 0.5) for i, s in enumerate(slacks)}
            | {name: Meaning(Kind.STEP, name[3:]) for name in mu},
        ),
        make_grid=lambda steps: SimpleNamespace(is_multiplier=np.zeros(9)),
        initial_guess=lambda grid: "guess",
        variable_bounds=lambda grid: ("lower", "upper"),
        unpack=lambda grid, vector: {"guess": unpacked, "lower": limits[0], "upper": limits[1]}[vector],
        evaluate=lambda grid, unknowns: SimpleNamespace(gradient="zeros"),
        views=lambda grid, vector: (None, np.full((bodies, steps, len(interval)), 0.0 if vector == "zeros" else 0.3)),
    )  # fmt: skip
    if conditions:
        first = len(names)
        module.SLACKS = first + np.arange(len(interval) - conditions, len(interval))
        module.SLACK_MULTIPLIERS = first + np.arange(len(mu), len(mu) + conditions)
    result = Result(
        problem="invented", title="Move " + "very " * 30 + "far.", task="control", method=method, scheme="midpoint",
        driver="newton", steps=steps, status="solved", message="", cost=1.0, residual=0.0, stationarity=0.0,
        iterations=3, t=t, q=wave, p=momenta, u=u, multipliers=multipliers, energy=None,
        log=10.0 ** -np.arange(18.0).reshape(3, 6), names={}, summary={"T": 1.0}, unknowns=np.zeros(1),
    )  # fmt: skip
    return module, result


def overlaps(figure: Figure) -> list[str]:
    """Pairs of panels whose boxes, with all labels, titles and legends, overlap, and what leaves the page."""
    FigureCanvasAgg(figure)
    figure.draw_without_rendering()
    renderer = figure.canvas.get_renderer()
    parts = [(axes.get_ylabel() or "drawing", axes.get_tightbbox(renderer)) for axes in figure.axes]
    parts += [("legend", legend.get_window_extent(renderer)) for legend in figure.legends]
    if figure._suptitle is not None:
        parts.append(("title", figure._suptitle.get_window_extent(renderer)))
    found = []
    for (one, a), (other, b) in itertools.combinations(parts, 2):
        wide, high = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
        found += [f"{one} and {other}"] if wide > 1.0 and high > 1.0 else []
    page = figure.bbox
    found += [name for name, box in parts if box.x0 < -1 or box.y0 < -1 or box.x1 > page.x1 + 1 or box.y1 > page.y1 + 1]
    return found


def picture(bodies: int, height: float = 1.0) -> Scene:
    """All kinds of items, for some bodies."""
    t = np.linspace(0.0, 1.0, 7)
    x, y = t + 0.3 * np.arange(bodies)[:, None], height * t**2 + 0.0 * np.arange(bodies)[:, None]
    one = np.ones((1, 1))
    place = (x, y)
    return Scene(
        t,
        (
            Ground((-one, 0 * one), (3 * one, 0 * one), label="ground"),
            Circle((one, one), one, label="target"),
            Mark((one, one), label="centre"),
            Trail(place, label="path"),
            Rod((0 * x, 0 * y), place, label="arm"),
            Box(place, 0.2 + 0 * x, 0.1 + 0 * x, x, label="hull"),
            Mass(place, 0.05 + 0 * x, label="bob"),
            Arrow(place, (0.3 + 0 * x, 0.1 + 0 * y), label="force"),
        ),
    )
