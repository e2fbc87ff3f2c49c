"""Problems with delays as people read them: values of the past, histories, and the segments that take their place."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import sympy
from sympy import Expr, Symbol

from codegen.model import Model
from codegen.show.notation import Block

Rows = Sequence[tuple[Symbol, Expr]]


def is_past(name: str) -> bool:
    """Whether a name is that of a value of the past."""
    return "@t-" in name


def with_past(model: Model) -> Model:
    """The model with values of the past as quantities of their own, whose equations are none of the problem's."""
    coordinates: dict[Symbol, Symbol] = {}
    controls = []
    for delay in model.delays:
        x, lag = delay.quantity, delay.symbol.name.partition("@")[2]
        if x in model.controls:
            controls.append(delay.symbol)
            continue
        if x not in (*model.coordinates, *model.rates):  # a velocity, where momenta are the rates
            continue
        index = (model.rates if x in model.rates else model.coordinates).index(x)
        rate = f"{model.rates[index]}@{lag}" if model.rates else ""
        coordinates[Symbol(f"{model.coordinates[index]}@{lag}", real=True)] = Symbol(rate, real=True)
    if not model.delays:
        return model
    none = (None,) * len(coordinates)
    zeros = (sympy.S.Zero,) * len(coordinates)
    first_order = model.form == "first-order"
    assert model.end is not None, "only control problems have delays"
    rates = none if model.rates else ()
    return replace(
        model,
        coordinates=(*model.coordinates, *coordinates),
        rates=(*model.rates, *coordinates.values()) if model.rates else (),
        controls=(*model.controls, *controls),
        force=() if first_order else (*model.force, *zeros),
        dynamics=(*model.dynamics, *zeros) if first_order else (),
        start=replace(model.start, positions=(*model.start.positions, *none), rates=(*model.start.rates, *rates)),
        end=replace(model.end, positions=(*model.end.positions, *none), rates=(*model.end.rates, *rates)),
    )


def delay_blocks(model: Model) -> Iterator[Block]:
    """The histories, and how the motion is cut."""
    whole, segments = model.authored, model.segments
    if not whole.delays:
        return
    histories = {delay.quantity: delay.history for delay in whole.delays}
    yield Block("Before t = 0", tuple(histories.items()))
    if segments is not None and segments.number > 1:
        backs = {delay.lag: back for delay, back in zip(whole.delays, segments.steps_back, strict=True) if back}
        counts = {lag: f"{back} segment{'s' if back > 1 else ''}" for lag, back in backs.items()}
        shifts = ", ".join(f"t - {lag} is {count} before" for lag, count in counts.items())
        text = (
            f"{segments.number} segments of length {model.duration} run side by side, each beginning where the one "
            f"before it ends: {shifts}, at the same point of a step"
        )
        yield Block("Method of steps", (), ((text, text + r"\\"),))


def of_the_whole(model: Model, rows: Rows) -> tuple[tuple[Symbol, Expr], ...]:
    """What holds at the ends of the whole motion, without what joins segments."""
    if model.segments is None:
        return tuple(rows)
    names = {own: (whole, number) for own, whole, number in model.segments.names}
    ends = {"0": 1, "T": model.segments.number}
    kept = []
    for symbol, value in rows:
        name, mark, end = symbol.name.rpartition("@")
        stem = "p_" if name not in names and name.startswith("p_") else ""
        whole, number = names.get(name.removeprefix(stem), ("", 0))
        if number == ends.get(end):
            kept.append((Symbol(f"{stem}{whole}{mark}{end}", real=True), value))
    return tuple(kept)
