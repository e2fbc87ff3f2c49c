"""Names of the user's quantities: without conflicts in generated code, and in LaTeX.

Any identifier may name a quantity. A generated module, or a derived quantity, may need the same name. A mark is then
added to the name of the user's symbol in all stages, so that the two are never confused. In the code of the module an
underscore replaces the mark: `steps` becomes the argument `steps_` of `solve`. Metadata, docstrings, comments and
messages show the name of the user.
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
"""The mark: a letter, so that marked names are identifiers. Names of quantities must not contain it."""

_TEMPLATES = {
    "control": ("header", "kernel", "control"),
    "simulate": ("header", "kernel", "simulate"),
    "particles": ("header", "pair_loop", "particle_loop", "particles"),
    "connect": ("header", "pair_loop", "particle_loop", "gathered_loop", "passive_loop", "connect"),
}
"""The templates from which the module of each kind of problem is generated."""
_IN_KERNELS = {
    "control": "unknowns t h parameters gradient hessian block values slopes curvatures common duration body own "
    "shared_views lower_own upper_own lower_common upper_common NODE START END BODIES PHASES node_times interval_times "
    "with_slacks checked_grid with_inner_times with_tables with_observations",
    "simulate": "unknowns t h parameters state lengths interval residual jacobian inputs values Kernel Value "
    "step_inputs",
}
_IN_LOOPS = (
    "z own parameters singles rates gradient hessian products directions margin place fraction start target energy "
    "half row_i row_j slope velocity matrix accurate_dot x_minus_log1p log1p_minus_ratio CLOSEST BLOCK factor i j row "
    "count columns carray Kernel Value Contracted energy"
)
"""Names of arguments and local variables of kernels and loops, and of functions that they call."""
_AT_NODES = re.compile(r"(_k|_k1|_stage\d+)$|^_")
"""Pattern of the names of values at nodes and stages, and of temporary variables, in generated code."""
_IN_PAIRS = re.compile(r"_alone$|^[hmsxy]\d+$|^(by|d)_|_[ij]$")
"""Pattern of names in the code of pair terms.

It matches scalars that depend on both particles, derivatives with respect to these scalars, and quantities of one
particle.
"""
_OF_TIME = ("t", "h", "h_1", "h_2", "duration")
"""Symbols that discrete equations contain in addition to the symbols of the user."""
_DERIVED = "lambda mu nu p pi psi start end switch coupled periodic d".split()
"""Prefixes in the names of multipliers, partners and boundary values of a quantity."""
_GREEK = re.compile(r"GREEK (SMALL|CAPITAL) LETTER (\w+)$")
"""Pattern of the Unicode names of Greek letters."""


def marked(name: str, task: str, others: Collection[str], *, moving: bool) -> str:
    """Return the name of a quantity, with a mark at its end if generated code may need the same name.

    `task` is the kind of module, whose code needs certain names. `others` are the names of other quantities, from which
    names such as `lambda_x` are derived. The code has no variable with the name of a `moving` quantity itself, but only
    longer names for its values at nodes.
    """
    derived = {f"{stem}_{other}" for stem in _DERIVED for other in others}
    made = bool(_AT_NODES.search(name) or (task in ("particles", "connect") and _IN_PAIRS.search(name)))
    if not name.isascii() or made or name in (_OF_TIME if moving else _needed(task)) or name in derived:
        return name + MARK
    return name


def plain(text: str) -> str:
    """Return a text without marks, which then has the names of the user."""
    return text.replace(MARK, "")


def renamed(text: str) -> str:
    """Return the text of a module with underscores in place of marks in code, and without marks in other text.

    If the name with an underscore exists already, further underscores are added. Letters that are not ASCII are spelled
    out, for example `theta`.
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
    """Return lines for the docstring of a module, which list arguments whose names differ from their parameters."""
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
    """Return a name in ASCII; Greek letters are replaced by their names, other letters by their Unicode numbers."""
    return "".join(letter if letter.isascii() else _word(letter) for letter in name)


def _word(letter: str) -> str:
    greek = _GREEK.match(unicodedata.name(letter, ""))
    if greek:
        return greek[2].lower() if greek[1] == "SMALL" else greek[2].capitalize()
    return f"u{ord(letter):04x}"


@cache
def _needed(task: str) -> frozenset[str]:
    """Return the names that the code of a module for the task needs: in templates, in kernels, and in Python itself."""
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
"""Capital Greek letters that LaTeX has; the other ones look like Latin letters."""
_VARIANTS = {"phi": r"\varphi", "epsilon": r"\varepsilon"}
_NUMBERED = re.compile(r"(?<=[^\W\d_])(\d+)$")


_POWER = re.compile(r"(?:\*\*|\^)(-?\d+)")
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def in_latex(name: str) -> str:
    """Return a name in LaTeX.

    Both `theta1` and `theta_1` become a Greek letter with an index, `rod` becomes an upright word, and `m_dry_1`
    becomes a letter with two indices.
    """
    parts = [part for part in name.split("_") if part]
    if not parts:
        return word(name)
    first, *indices = [*_NUMBERED.sub(r"_\1", parts[0]).split("_"), *parts[1:]]
    below = ",".join(word(part) for part in indices)
    return word(first) + (f"_{{{below}}}" if below else "")


def word(text: str) -> str:
    """Return a word without indices in LaTeX.

    A single letter is italic, the name of a Greek letter becomes the letter, and other words are upright.
    """
    match = _GREEK.match(unicodedata.name(text, "")) if len(text) == 1 else None
    if match:
        text = match[2].lower().replace("lamda", "lambda")
        text = text.capitalize() if match[1] == "CAPITAL" else text
    if text in _SMALL or text in _CAPITAL:
        return _VARIANTS.get(text, "\\" + text)
    is_letter = len(text) == 1 and text.isalpha()
    return text if is_letter or text.isdigit() else r"\mathrm{" + text.replace("_", r"\_") + "}"


def written_unit(unit: str) -> str:
    """Return a unit with a dot for `*` and raised exponents; an empty string for pure numbers."""
    if unit.strip() in ("", "1", "dimensionless"):
        return ""
    return _POWER.sub(lambda match: match[1].translate(_RAISED), unit).replace("*", "·")
