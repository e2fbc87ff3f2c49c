"""Names of an author's quantities: without conflicts in generated code, and in LaTeX.

Any identifier may name a quantity. If a generated module, or a derived quantity, needs the same name, the author's
symbol has a mark in all stages, so that the two are never confused. In the text of the module, code has an underscore
in place of the mark: `steps` becomes the argument `steps_` of `solve`. Metadata, docstrings, comments and messages show
the author's name.
"""

from __future__ import annotations

import builtins
import io
import keyword
import re
import tokenize
import unicodedata
from collections.abc import Collection, Iterable
from functools import cache
from importlib import resources

MARK = "\ua78f"
"""A letter, so that marked names are identifiers; it is in no author's name."""

_TEMPLATES = {
    "control": ("header", "kernel", "control"),
    "simulate": ("header", "kernel", "simulate"),
    "particles": ("header", "pair_loop", "particle_loop", "particles"),
    "connect": ("header", "pair_loop", "particle_loop", "gathered_loop", "passive_loop", "connect"),
}
"""The templates that make the module of each kind of problem."""
_IN_KERNELS = {
    "control": "unknowns t h parameters gradient hessian block values slopes curvatures common duration body own "
    "shared_views lower_own upper_own lower_common upper_common NODE START END BODIES PHASES node_times interval_times "
    "with_slacks checked_grid with_inner_times with_tables with_observations",
    "simulate": "unknowns t h parameters state lengths interval residual jacobian inputs Kernel Value step_inputs",
}
_IN_LOOPS = (
    "z own parameters singles rates gradient hessian products directions margin place fraction start target energy "
    "half row_i row_j slope velocity matrix accurate_dot x_minus_log1p log1p_minus_ratio CLOSEST BLOCK factor i j row "
    "count columns carray Kernel Value Contracted energy"
)
"""Names of arguments and locals of kernels and loops, and of functions that these call."""
_AT_NODES = re.compile(r"(_k|_k1|_stage\d+)$|^_")
"""Names of values at nodes and stages, and of temporaries."""
_IN_PAIRS = re.compile(r"_alone$|^[hmsxy]\d+$|^(by|d)_|_[ij]$")
"""Names of scalars of a pair and of derivatives by them, and of quantities of one of the two particles."""
_OF_TIME = ("t", "h", "h_1", "h_2", "duration")
"""Symbols of discrete equations in addition to the author's."""
_DERIVED = "lambda mu nu p pi psi start end switch coupled periodic d".split()
"""First parts of the names of multipliers, partners and boundary values of a quantity."""
_GREEK = re.compile(r"GREEK (SMALL|CAPITAL) LETTER (\w+)$")


def marked(name: str, task: str, others: Collection[str], *, moving: bool) -> str:
    """Return a name, with a mark at its end if a module for the task needs it, or derives it from one of the others.

    A `moving` quantity has values at nodes, whose names are longer.
    """
    derived = {f"{stem}_{other}" for stem in _DERIVED for other in others}
    made = bool(_AT_NODES.search(name) or (task in ("particles", "connect") and _IN_PAIRS.search(name)))
    if not name.isascii() or made or name in (_OF_TIME if moving else _needed(task)) or name in derived:
        return name + MARK
    return name


def plain(text: str) -> str:
    """Return a text with the author's names."""
    return text.replace(MARK, "")


def renamed(text: str) -> str:
    """Return the text of a module with underscores in place of marks in code, and without marks in other text.

    A name that is taken has further underscores; letters that are not ASCII are spelled out.
    """
    if MARK not in text:
        return text
    tokens = list(tokenize.generate_tokens(io.StringIO(text).readline))
    names = {token.string for token in tokens if token.type == tokenize.NAME}
    new = _new_names(sorted(name for name in names if MARK in name), {name for name in names if MARK not in name})
    lines = text.splitlines(keepends=True)
    for token in reversed(tokens):
        if token.type == tokenize.NAME and token.string in new:
            (row, begin), (_, end) = token.start, token.end
            lines[row - 1] = lines[row - 1][:begin] + new[token.string] + lines[row - 1][end:]
    renamed_text = re.sub(rf"(\w+?{MARK}){MARK}", lambda match: new[match[1]], "".join(lines))
    return plain(renamed_text)


def renamed_arguments(names: Iterable[str]) -> list[str]:
    """Return lines of a module's docstring that list the arguments with other names than their parameters."""
    marks = [name for name in names if MARK in name]
    listed = ", ".join(f"{name}{MARK} for {name}" for name in marks)
    return ["", f"Arguments whose names mean something else here are called: {listed}."] if marks else []


def _new_names(names: Iterable[str], taken: set[str]) -> dict[str, str]:
    new = {}
    for name in names:
        marks = "" if not name.isascii() and plain(name) != _spelled(plain(name)) else "_"
        while (spelled := _spelled(name.replace(MARK, marks))) in taken or keyword.iskeyword(spelled):
            marks += "_"
        taken.add(spelled)
        new[name] = spelled
    return new


def _spelled(name: str) -> str:
    """Return a name in ASCII: Greek letters by their names, others by their numbers."""
    return "".join(letter if letter.isascii() else _word(letter) for letter in name)


def _word(letter: str) -> str:
    greek = _GREEK.match(unicodedata.name(letter, ""))
    if greek:
        return greek[2].lower() if greek[1] == "SMALL" else greek[2].capitalize()
    return f"u{ord(letter):04x}"


@cache
def _needed(task: str) -> frozenset[str]:
    """Return the names in templates and in lowering, and the names of Python."""
    words = {*dir(builtins), *keyword.kwlist, *keyword.softkwlist, "np", "math", "prange", "body"}
    words |= {*_IN_KERNELS.get(task, _IN_LOOPS).split(), *_OF_TIME}
    for template in _TEMPLATES[task]:
        text = resources.files("codegen.emit").joinpath("templates", f"{template}.py.j2").read_text(encoding="utf-8")
        for other in (r"\{%.*?%\}", r"\{\{.*?\}\}", r'""".*?"""', r"#[^\n]*", r'f?"[^"\n]*"'):
            text = re.sub(other, " ", text, flags=re.DOTALL)
        words |= set(re.findall(r"(?<![\w.])[A-Za-z_]\w*", text))
    return frozenset(words)


_SMALL = set(
    "alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi pi rho sigma tau upsilon phi chi psi "
    "omega".split()
)
_CAPITAL = set("Gamma Delta Theta Lambda Xi Pi Sigma Upsilon Phi Psi Omega".split())
"""Capital letters of LaTeX; the others look like Latin letters."""
_VARIANTS = {"phi": r"\varphi", "epsilon": r"\varepsilon"}
_NUMBERED = re.compile(r"(?<=[^\W\d_])(\d+)$")


_POWER = re.compile(r"(?:\*\*|\^)(-?\d+)")
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def in_latex(name: str) -> str:
    """Return a name in LaTeX: `theta1` and `theta_1` are a letter with an index, `rod` is a word, `m_dry_1` has two."""
    parts = [part for part in name.split("_") if part]
    if not parts:
        return word(name)
    first, *indices = [*_NUMBERED.sub(r"_\1", parts[0]).split("_"), *parts[1:]]
    below = ",".join(word(part) for part in indices)
    return word(first) + (f"_{{{below}}}" if below else "")


def word(text: str) -> str:
    """Return a word without indices: one letter is italic, a Greek letter's name is that letter, others are upright."""
    match = _GREEK.match(unicodedata.name(text, "")) if len(text) == 1 else None
    if match:
        text = match[2].lower().replace("lamda", "lambda")
        text = text.capitalize() if match[1] == "CAPITAL" else text
    if text in _SMALL or text in _CAPITAL:
        return _VARIANTS.get(text, "\\" + text)
    is_letter = len(text) == 1 and text.isalpha()
    return text if is_letter or text.isdigit() else r"\mathrm{" + text.replace("_", r"\_") + "}"


def written_unit(unit: str) -> str:
    """Return an author's unit with mathematical signs; an empty string for pure numbers."""
    if unit.strip() in ("", "1", "dimensionless"):
        return ""
    return _POWER.sub(lambda match: match[1].translate(_RAISED), unit).replace("*", "·")
