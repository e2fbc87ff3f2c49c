"""Derived equations as text, as LaTeX, and as a notebook shows them."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from codegen.author.sources import Source
from codegen.show.equations import equations


@dataclass(frozen=True)
class Equations:
    """The equations of a problem and of its discretisation; `str` of it is the `text` of `codegen show`.

    `latex` needs the package amsmath and no other. In a notebook they are mathematics.
    """

    text: str
    _latex: Callable[[], str]

    @cached_property
    def latex(self) -> str:
        """The same as LaTeX, derived when it is asked for."""
        return self._latex()

    def __str__(self) -> str:
        return self.text

    def __repr__(self) -> str:
        return self.text

    def _repr_markdown_(self) -> str:
        return as_markdown(self.latex)


def derived_equations(
    problem: Source | Path | str,
    arguments: Mapping[str, str],
    scheme: str | None = None,
    method: str | None = None,
    controls: str = "interval",
) -> Equations:
    """The equations of a problem file, or of an object; raises what `equations` does."""

    def written(latex: bool) -> str:
        return equations(problem, arguments, scheme=scheme, method=method, controls=controls, latex=latex)

    return Equations(written(False), lambda: written(True))


_HEADING = re.compile(r"^\\(section\*|paragraph)\{(.*)\}$", re.MULTILINE)
_ALIGNED = re.compile(r"\\begin\{align\*\}\n(.*?)\n\\end\{align\*\}", re.DOTALL)
_ESCAPE = re.compile(r"\\([_%&#$^{}])")


def as_markdown(latex: str) -> str:
    """LaTeX as `codegen show --latex` writes it in the Markdown of notebooks, whose mathematics stands between $."""

    def heading(found: re.Match[str]) -> str:
        mark = "###" if found[1] == "section*" else "####"
        return f"{mark} {_ESCAPE.sub(lambda own: own[1], found[2])}"

    def aligned(found: re.Match[str]) -> str:
        return f"\n$$\n\\begin{{aligned}}\n{found[1]}\n\\end{{aligned}}\n$$"

    outside = re.sub(r"^([^&\n]*)\\\\$", r"\1  ", _HEADING.sub(heading, latex), flags=re.MULTILINE)
    return _ALIGNED.sub(aligned, outside)
