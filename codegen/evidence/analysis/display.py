"""Modified equations of a problem file, laid out for people to read: the conclusion first, then power by power."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import sympy
from sympy import Expr, Symbol

from codegen.discretise import schemes, transcribe
from codegen.discretise.model import legendre
from codegen.discretise.model.definitions import Model
from codegen.discretise.model.from_problem import load_problem
from codegen.discretise.model.pairwise import PairwiseModel
from codegen.discretise.schemes.one_step import alpha
from codegen.errors import ArgumentError
from codegen.evidence.analysis.modified_equations import ModifiedEquations, modified_equations
from codegen.problem.sources import settings_of
from codegen.show.notation import Block, Notation, written

LARGEST_ORDER = 8
_FAMILY = "alpha"
_FACTOR_LIMIT = 400
"""Operation count up to which factors are looked for."""
_WRITING_LIMIT = 1200
"""Operation count up to which an expression is written out."""
_HIGH = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
_LOW = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def analysis(
    path: Path | str,
    arguments: Mapping[str, str] | None = None,
    *,
    scheme: str | None = None,
    method: str | None = None,
    order: int = 3,
    latex: bool = False,
) -> str:
    """The modified equations of a scheme on a problem up to h^order, as text of about 100 columns or as LaTeX.

    `scheme` is a name of the registries, or `alpha` for the whole family with a symbol in place of a number. Raises
    ArgumentError for an order outside 1 to 8 and for problems that have no modified equations here (particles, several
    phases, holonomic constraints, values of the past), and what `modified_equations` raises.
    """
    if not 1 <= order <= LARGEST_ORDER:
        raise ArgumentError(f"--order {order}", f"give a power of h from 1 to {LARGEST_ORDER}")
    model = _analysable(load_problem(Path(path), settings_of(path, arguments)))
    found = _scheme(model, scheme or transcribe.DEFAULT_SCHEME, method)
    result = modified_equations(model, found, order)
    side = legendre.hamiltonian_form(model.with_free_ends)
    notation = Notation.of(side, latex=latex)
    blocks = [*_equations(result, model, notation), *_structure(result, notation)]
    return written(f"{found.name} on {model.name}: {_conclusion(result, latex)}", blocks, notation)


def _analysable(model: Model | PairwiseModel) -> Model:
    reason = ""
    if isinstance(model, PairwiseModel):
        reason = "particles that interact in pairs"
    elif model.phases:
        reason = "several phases"
    elif model.holonomic:
        reason = "holonomic constraints"
    elif model.segments:
        reason = "values of the past"
    if reason:
        raise ArgumentError(
            f"modified equations are not derived for {reason}",
            "analyse one body, one phase, or independent coordinates by themselves",
        )
    assert isinstance(model, Model)
    return model


def _scheme(model: Model, name: str, method: str | None) -> schemes.Scheme:
    """The scheme of that name; without a method, that of the side on which the problem is written if it has it."""
    usable = transcribe.methods_for(model)
    if method is not None and method not in usable:
        raise ArgumentError(f"method {method!r} is not for a {model.form} problem", f"use {' or '.join(usable)}")
    if name == _FAMILY and "hamiltonian" in usable and method in (None, "hamiltonian"):
        return _family(model)
    return schemes.find(name, method or transcribe.method_with(model, name))


def _family(model: Model) -> schemes.Scheme:
    """The alpha family with a symbol that the problem does not use."""
    taken = {s.name for s in (*model.coordinates, *model.rates, *model.controls, *model.parameters)}
    name = next(n for n in ("alpha", "beta", "gamma", "weight", "family_weight") if n not in taken)
    return replace(alpha(Symbol(name, real=True)), name=f"{name} family")


def _conclusion(result: ModifiedEquations, latex: bool) -> str:
    power = _power(len(result.field) - 1, latex)
    if result.defects is None:
        return f"modified equations up to {power}, of a first-order system, which has no Hamiltonian"
    if result.defects:
        powers = sorted({defect.power for defect in result.defects})
        names = [_power(k, latex) for k in powers]
        terms = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
        return f"modified equations up to {power} are not Hamiltonian, because of the coefficients of {terms}"
    found = "" if result.hamiltonian else ", but no modified Hamiltonian was found"
    return f"modified equations up to {power} are Hamiltonian{found}"


def _power(k: int, latex: bool) -> str:
    if latex:
        return "h" if k == 1 else f"h to the power {k}"
    return "h" if k == 1 else "h" + str(k).translate(_HIGH)


def _equations(result: ModifiedEquations, model: Model, notation: Notation) -> Iterator[Block]:
    names = ", ".join(notation.name(x) for x in result.states)
    last = len(result.field)
    plain = " + ".join(["f₀", "h f₁", *(f"h{_high(k)} f{_low(k)}" for k in range(2, last))])
    tex = " + ".join(["f_0", "h f_1", *(f"h^{{{k}}} f_{{{k}}}" for k in range(2, last))])
    remarks = [
        (
            f"ż = {plain} + O(h{_high(last)}), z = ({names}); its flow over the time h is a step",
            rf"$\dot{{z}} = {tex} + O(h^{{{last}}})$, $z = ({names})$; its flow over the time $h$ is a step.",
        )
    ]
    for statement, holds in (
        ("controls are constants", bool(model.controls)),
        (f"each of the {model.bodies} bodies by itself", model.bodies > 1),
    ):
        remarks += [(statement, statement)] if holds else []
    yield Block("Modified equations", (), tuple(remarks))
    for k, field in enumerate(result.field):
        rates = [
            (Symbol(f"rate {x.name}", real=True), _tidied(f, k)) for x, f in zip(result.states, field, strict=True)
        ]
        yield _block(f"Coefficient of {_power(k, notation.latex)}", rates, notation)


def _block(heading: str, rows: list[tuple[Symbol, Expr]], notation: Notation) -> Block:
    """Equations, and in words what vanishes or is too long to be read."""
    remarks: list[tuple[str, str]] = []
    vanishing = [notation.name(label) for label, value in rows if value == 0]
    if len(vanishing) == len(rows):
        return Block(heading, (), (("it vanishes",) * 2,))
    if vanishing:
        listed, marked = ", ".join(vanishing), ", ".join(f"${name}$" for name in vanishing)
        remarks.append((f"no contribution to {listed}", f"No contribution to {marked}."))
    shown = []
    for label, value in rows:
        operations = value.count_ops()
        if operations > _WRITING_LIMIT:
            name = notation.name(label)
            statement = "is not written out: it has"
            remarks.append(
                (f"{name} {statement} {operations} operations", f"${name}$ {statement} {operations} operations.")
            )
        elif value != 0:
            shown.append((label, value))
    return Block(heading, tuple(shown), tuple(remarks))


def _structure(result: ModifiedEquations, notation: Notation) -> Iterator[Block]:
    """The modified Hamiltonian, or what shows that there is none."""
    if result.hamiltonian:
        last = len(result.hamiltonian)
        plain = " + ".join(["H₀", "h H₁", *(f"h{_high(k)} H{_low(k)}" for k in range(2, last))])
        tex = " + ".join(["H_0", "h H_1", *(f"h^{{{k}}} H_{{{k}}}" for k in range(2, last))])
        statement = "checked by differentiation; constants, and functions of time alone, are left out"
        rows = [(Symbol(f"H_{k}", real=True), _tidied(h, k)) for k, h in enumerate(result.hamiltonian)]
        block = _block("Modified Hamiltonian", rows, notation)
        remark = (
            f"H̃ = {plain} + O(h{_high(last)}), {statement}",
            rf"$\tilde{{H}} = {tex} + O(h^{{{last}}})$, {statement}.",
        )
        yield Block(block.heading, block.equations, (remark, *block.remarks))
    for k in sorted({defect.power for defect in result.defects or ()}):
        rows = [
            (Symbol(f"omega_{a.name}_{b.name}", real=True), _tidied(defect.value, k))
            for defect in result.defects or ()
            for a, b in [defect.pair]
            if defect.power == k
        ]
        block = _block(f"Why the coefficient of {_power(k, notation.latex)} is not Hamiltonian", rows, notation)
        remark = (
            "d(i_f ω) = Σ ω_ab da ∧ db does not vanish, where ω = Σ dq ∧ dp",
            r"$d(i_f \omega) = \sum \omega_{ab}\, da \wedge db$ does not vanish, where $\omega = \sum dq \wedge dp$.",
        )
        yield Block(block.heading, block.equations, (remark, *block.remarks))


def _high(k: int) -> str:
    return "" if k == 1 else str(k).translate(_HIGH)


def _low(k: int) -> str:
    return str(k).translate(_LOW)


def _tidied(expression: Expr, power: int) -> Expr:
    """The shorter of a sum and its product of factors; what the author wrote stays as it is."""
    if power == 0 or expression.count_ops() > _FACTOR_LIMIT:
        return expression
    return min(expression, sympy.factor(expression), key=lambda candidate: int(candidate.count_ops()))
