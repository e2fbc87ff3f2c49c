"""The notation of derived equations: symbols as in a textbook, written as plain text or as LaTeX."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import sympy
from sympy import Add, Expr, Symbol, expand_mul
from sympy.printing.pretty.pretty import PrettyPrinter
from sympy.printing.pretty.stringpict import prettyForm

from codegen import identifiers
from codegen.discretise.model.definitions import Model

WIDTH = 100
_LATEX_WIDTH = 90
_DIGITS, _LONGEST_FRACTION = 7, 14
"""Significant digits of decimals, and the largest number of characters of a fraction that is shown as such."""
_PLAIN = 10  # the largest denominator of a fraction that is never shown as a decimal
_INDEX = re.compile(r"^(?P<base>.+?)(?:_stage(?P<stage>\d+))?(?:_k(?P<shift>1|-1)?|@(?P<end>[0T])|@(?P<side>[+-]))?$")
_WORD = re.compile(r"[^\W\d]\w*")
_INVISIBLE = re.compile(r"\\(left|right|frac|mathrm|operatorname)|[{}^_\s]")
"""Parts of LaTeX that have no width on paper; estimates of the width ignore them."""
_GREEK = (
    "alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi omicron pi rho sigma tau upsilon phi chi "
    "psi omega"
).split()
_LETTERS = dict(zip(_GREEK, "αβγδεζηθικλμνξοπρστυφχψω", strict=True))
_LETTERS |= {name.capitalize(): letter.upper() for name, letter in list(_LETTERS.items())}
_LOW = str.maketrans("0123456789+-k", "₀₁₂₃₄₅₆₇₈₉₊₋ₖ")
_HIGH = str.maketrans("0123456789+-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁺⁻")


class _Printer(PrettyPrinter):  # type: ignore[misc]
    """A printer that writes the names of symbols unchanged."""

    def _print_Symbol(self, e: Symbol, bold_name: bool = False) -> prettyForm:
        return prettyForm(e.name)


@dataclass(frozen=True)
class Block:
    """A heading, equations as pairs (left, right), and remarks as pairs (plain text, LaTeX)."""

    heading: str
    equations: tuple[tuple[Expr, Expr], ...] = ()
    remarks: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Notation:
    """The translation of internal symbols to printed symbols; `velocities` maps the name dq to the name q.

    Internal names end in `_k`, `_k1`, `_k-1` at nodes and in `_stage1` inside a step. They end in `@0` and `@T` at the
    start and end, in `@-` and `@+` before and after a switch of phases. Before these, `@t-1/2` marks a past value.
    The prefix `rate ` marks the first time derivative, `acceleration ` the second, and `f `, `f- ` or `f+ ` forces.
    """

    velocities: dict[str, str]
    latex: bool

    @classmethod
    def of(cls, *models: Model, latex: bool = False) -> Notation:
        """Return the notation of models; a velocity named d<coordinate> is printed as the coordinate with a dot."""
        pairs = [
            pair
            for model in models
            if model.form == "lagrangian"
            for pair in zip(model.rates, model.coordinates, strict=True)
        ]
        named = [(identifiers.plain(v.name), identifiers.plain(q.name)) for v, q in pairs]
        return cls({v: q for v, q in named if v == f"d{q}"}, latex)

    def translated(self, expression: Expr) -> Expr:
        """Return the expression with printed names as symbols; a prime distinguishes symbols that print alike.

        Long fractions, which measured numbers have, become decimals with `_DIGITS` digits. So do those that authors
        usually write as decimals, such as 1/20 and 1/200000.
        """
        names = {symbol: self.name(symbol) for symbol in expression.free_symbols}
        unmarked = {name for symbol, name in names.items() if identifiers.MARK not in symbol.name}
        primed = {s for s, name in names.items() if identifiers.MARK in s.name and name in unmarked}
        shown: dict[Expr, Expr] = {s: Symbol(n + "'" * (s in primed), real=True) for s, n in names.items()}
        numbers = expression.atoms(sympy.Rational)
        shown |= {r: sympy.Float(r, _DIGITS) for r in numbers if len(str(r)) > _LONGEST_FRACTION or _is_decimal(r)}
        return expression.xreplace(shown)

    def name(self, symbol: Symbol) -> str:
        """Return the printed form of one symbol."""
        match = _INDEX.match(symbol.name)
        assert match is not None
        index = ""
        if symbol.name != match["base"] and not match["end"] and not match["side"]:
            index = {None: "k", "1": "k+1", "-1": "k-1"}[match["shift"]]
        base, _, lag = identifiers.plain(match["base"]).partition("@t-")
        stage, (letter, low, high, dots) = match["stage"], self._parts(base)
        high = f"({stage})" if stage else high
        if self.latex:
            lows = ",".join(part for part in (low, index) if part)
            written = rf"\{'d' * dots}ot{{{letter}}}" if dots else letter
            written += (f"^{{{high}}}" if high else "") + (f"_{{{lows}}}" if lows else "")
        else:
            marks = "\u0307" * dots if dots < 2 else "\u0308"
            written = letter + marks + high.translate(_HIGH).replace("(", "⁽").replace(")", "⁾")
            written += (f"_{low}" if low and not low.isdigit() else low.translate(_LOW)) + index.translate(_LOW)
        if lag:
            return f"{written}(t - {_WORD.sub(lambda match: self._letter(match[0]), lag)})"
        if match["side"]:
            return written + (f"^{{{match['side']}}}" if self.latex else match["side"].translate(_HIGH))
        return written + (f"({match['end']})" if match["end"] else "")

    def _parts(self, base: str) -> tuple[str, str, str, int]:
        """Return the letter, subscript, superscript and number of dots of an internal name."""
        mark, _, rest = base.rpartition(" ")
        if mark in ("f", "f-", "f+"):
            return "f", self._letter(rest), mark[1:], 0
        dots = {"rate": 1, "acceleration": 2}.get(mark, 0)
        if rest in self.velocities:
            rest, dots = self.velocities[rest], dots + 1
        letter, _, low = rest.partition("_")
        digits = re.fullmatch(r"([^\W\d]+)(\d+)", letter)
        if digits and not low:
            letter, low = digits[1], digits[2]
        parts = [f"({part[5:]})" if re.fullmatch(r"stage\d+", part) else self._letter(part) for part in low.split("_")]
        if not low:
            return self._letter(letter), "", "", dots
        return self._letter(letter), ("," if self.latex else "_").join(parts), "", dots

    def _letter(self, word: str) -> str:
        if word in self.velocities:
            word = self.velocities[word]
            return rf"\dot{{{self._letter(word)}}}" if self.latex else self._letter(word) + "\u0307"
        if not self.latex:
            return _LETTERS.get(word, word)
        return identifiers.word(word)


def written(title: str, blocks: Sequence[Block], notation: Notation) -> str:
    """Return the title and all blocks as plain text or LaTeX, without a newline at the end."""
    render = _latex_block if notation.latex else _plain_block
    head = rf"\section*{{{_escaped(title)}}}" if notation.latex else textwrap.fill(title, WIDTH)
    return "\n\n".join([head, *("\n".join(render(block, notation)) for block in blocks)])


def _plain_block(block: Block, notation: Notation) -> Iterator[str]:
    yield from (block.heading, "-" * len(block.heading))
    for plain, _ in block.remarks:
        yield from textwrap.wrap(plain, WIDTH, initial_indent="  ", subsequent_indent="    ")
    printer = _Printer({"use_unicode": True, "wrap_line": False})
    for left, right in block.equations:
        yield ""
        label, value = prettyForm(f"  {notation.translated(left).name} = "), notation.translated(right)
        room = WIDTH - label.width() - 2
        for i, row in enumerate(_rows(value, lambda e: int(printer._print(e).width()), room)):
            begin = label if i == 0 else prettyForm(" " * (label.width() - 2) + _sign(row))
            form = prettyForm(*begin.right(printer._print(row)))
            yield from (line.rstrip() for line in str(form).split("\n"))


def _latex_block(block: Block, notation: Notation) -> Iterator[str]:
    yield rf"\paragraph{{{_escaped(block.heading)}.}}"
    yield from (_escaped(plain) if plain == tex else tex for plain, tex in block.remarks)
    if not block.equations:
        return
    yield r"\begin{align*}"
    for number, (left, right) in enumerate(block.equations):
        label, value = notation.translated(left), notation.translated(right)
        rows = list(_rows(value, lambda e: len(_INVISIBLE.sub("", sympy.latex(e))), _LATEX_WIDTH))
        for i, row in enumerate(rows):
            begin = f"{label.name} &= " if i == 0 else r"&\quad " + _sign(row)
            last = number == len(block.equations) - 1 and i == len(rows) - 1
            yield begin + sympy.latex(row) + ("" if last else r" \\")
    yield r"\end{align*}"


def _rows(value: Expr, width: Callable[[Expr], int], room: int) -> Iterator[Expr]:
    """Yield the parts of a sum for lines of at most the width `room`; products are expanded if necessary."""
    if width(value) <= room:
        yield value
        return
    row: list[Expr] = []
    for term in _terms(value):
        for part in [term] if width(term) <= room else _terms(term):
            if row and width(Add(*row, part)) > room:
                yield Add(*row)
                row = []
            row.append(part)
    yield Add(*row)


def _terms(value: Expr) -> list[Expr]:
    return list(expand_mul(value, deep=False).as_ordered_terms())


def _sign(row: Expr) -> str:
    return "  " if row.as_ordered_terms()[0].could_extract_minus_sign() else "+ "


def _escaped(text: str) -> str:
    return re.sub(r"([_%&#$^{}])", r"\\\1", text)


def _is_decimal(number: sympy.Rational) -> bool:
    """Return True for a fraction in tens: its denominator has the prime factor 5, and no others than 2 and 5."""
    primes = sympy.factorint(number.q) if number.q > _PLAIN else {}
    return 5 in primes and {*primes} <= {2, 5}
