"""Orders at which costs of optima converge, with what is expected of them and what is to be said beside them.

Expected is the scheme's order, but 2 at most where controls are constant on intervals. Sources: Hager, Runge-Kutta
methods in optimal control and the transformed adjoint system, Numer. Math. 87 (2000), for smooth optima; Dontchev,
Hager and Veliov, Second-order Runge-Kutta approximations in control constrained optimal control, SIAM J. Numer. Anal.
38 (2000), and Dontchev and Hager, The Euler approximation in state constrained optimal control, Math. Comp. 70 (2001),
where bounds become active; Alt, Baier, Gerdts and Lempio, Error bounds for Euler approximation of linear-quadratic
control problems with bang-bang solutions, Numer. Algebra Control Optim. 2 (2012), for controls that switch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from codegen.report.building import Variant
from codegen.report.measure.meshes import all_grids
from codegen.report.measure.optima import limit, orders_of, references_of
from codegen.report.measure.orders import LARGE, Order, fitted_order, measured_order, verdict
from codegen.report.store import Store

ELSEWHERE = 1e-3
"""Limits that differ by more than this part, and by ten times their errors, belong to different local optima."""
EXACT = 1e-9
"""Where no relative error is larger, there is nothing to converge."""
OCTAVES = 16
"""A fit is over so large a range of the number of intervals."""


@dataclass(frozen=True)
class Convergence:
    """A measured order with its verdict, unknowns whose bounds become active within the motion, finest N, remarks."""

    order: Order | None
    said: str
    switching: tuple[str, ...] = ()
    finest: int | None = None
    error: float | None = None
    remark: str = ""


def convergence_of(store: Store, problem: Path, variant: Variant, expected: int) -> Convergence:
    """What the mesh sequence of a scheme shows."""
    values = store.get(orders_of(problem), variant.label)
    own = None if values is None else limit(values)
    if values is None or own is None:
        failure = "" if values is None else values["failure"]
        return Convergence(None, "no optimum on three successive grids", remark=failure)
    reference = store.get(references_of(problem), "cost") or {}
    switching, target, floor, remark = tuple(values["switching"]), own.value, own.error, ""
    if reference.get("cost") is not None:
        cost, known_to = float(reference["cost"]), float(reference["error"])
        if abs(own.value - cost) <= ELSEWHERE * (abs(cost) or 1.0) + 10.0 * (own.error + known_to):
            target, floor = cost, known_to
        else:
            remark = f"another local optimum, whose cost tends to {own.value:.6g}"
    scale = abs(target) or 1.0
    steps, costs = all_grids(values)
    errors = [abs(cost - target) / scale for cost in costs]
    last: dict[str, Any] = {"switching": switching, "finest": steps[-1], "error": errors[-1], "remark": remark}
    if max(errors) < EXACT:
        return Convergence(None, "exact on every grid", **last)
    if switching:
        order = _fitted(steps, errors, floor / scale, variant.label == reference.get("scheme") or bool(remark))
    else:
        order = measured_order(steps, errors, floor / scale)
    if order is None and values["failure"]:
        last["remark"] = "; ".join(text for text in (remark, f"ended at {values['failure']}") if text)
    return Convergence(order, verdict(order, expected), **last)


def _fitted(steps: Sequence[int], errors: Sequence[float], floor: float, is_reference: bool) -> Order | None:
    """The order over the finest range that the reference allows, which is fitted to the finest quarter itself.

    Coarse grids count only down to the first that has an optimum of another kind.
    """
    top = steps[-1] // 4 if is_reference else steps[-1]
    rows = [(n, error) for n, error in zip(steps, errors, strict=True) if top <= OCTAVES * n and n <= top]
    kept = rows[max((i + 1 for i, (_, error) in enumerate(rows) if error > LARGE), default=0) :]
    return fitted_order([n for n, _ in kept], [error for _, error in kept], floor)
