"""Names of quantities in LaTeX: Greek letters, indices, words upright; units as they are written."""

from __future__ import annotations

import re
import unicodedata

_SMALL = set(
    "alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi pi rho sigma tau upsilon phi chi psi "
    "omega".split()
)
_CAPITAL = set("Gamma Delta Theta Lambda Xi Pi Sigma Upsilon Phi Psi Omega".split())
"""Those that LaTeX has; the others look like Latin ones."""
_VARIANTS = {"phi": r"\varphi", "epsilon": r"\varepsilon"}
_GREEK = re.compile(r"GREEK (SMALL|CAPITAL) LETTER (\w+)$")
_NUMBERED = re.compile(r"(?<=[^\W\d_])(\d+)$")


_POWER = re.compile(r"(?:\*\*|\^)(-?\d+)")
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def in_latex(name: str) -> str:
    """A name as mathematics: `theta1` and `theta_1` are a letter with an index, `rod` is a word, `m_dry_1` has two."""
    parts = [part for part in name.split("_") if part]
    if not parts:
        return word(name)
    first, *indices = [*_NUMBERED.sub(r"_\1", parts[0]).split("_"), *parts[1:]]
    below = ",".join(word(part) for part in indices)
    return word(first) + (f"_{{{below}}}" if below else "")


def word(text: str) -> str:
    """A word without indices: one letter is italic, the name of a Greek one is that letter, several are upright."""
    found = _GREEK.match(unicodedata.name(text, "")) if len(text) == 1 else None
    if found:
        text = found[2].lower().replace("lamda", "lambda")
        text = text.capitalize() if found[1] == "CAPITAL" else text
    if text in _SMALL or text in _CAPITAL:
        return _VARIANTS.get(text, "\\" + text)
    is_letter = len(text) == 1 and text.isalpha()
    return text if is_letter or text.isdigit() else r"\mathrm{" + text.replace("_", r"\_") + "}"


def written_unit(unit: str) -> str:
    """A unit as its author wrote it, with the signs of mathematics; nothing for one of pure numbers."""
    if unit.strip() in ("", "1", "dimensionless"):
        return ""
    return _POWER.sub(lambda found: found[1].translate(_RAISED), unit).replace("*", "·")
