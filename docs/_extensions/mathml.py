"""Formulas as MathML by the converter of docutils: no script, no font, and screen readers read them."""

from __future__ import annotations

import re
from html import escape
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.errors import ExtensionError

_ARRAY = re.compile(r"\\(begin|end)\{array\}(?:\{[lcr|]*\})?")
"""What the converter does not know; sides of columns are a matter of the style sheet."""


def _written(node: nodes.Element, as_block: bool) -> str:
    text = _ARRAY.sub(r"\\\1{matrix}", node.astext()).replace(r"\\[1ex]", r"\\").replace(r"\dots", r"\ldots")
    if as_block and "\\\\" in text and "\\begin" not in text:
        text = rf"\begin{{aligned}}{text}\end{{aligned}}"
    try:
        return str(tex2mathml(text, as_block=as_block))
    except MathError as error:
        raise ExtensionError(f"{node.source}:{node.line}: {error} in {text}") from error


def inline(writer: Any, node: nodes.Element) -> None:
    """Write a formula in a line of text."""
    writer.body.append(f'<span class="math">{_written(node, False)}</span>')
    raise nodes.SkipNode


def block(writer: Any, node: nodes.Element) -> None:
    """Write a formula on lines of its own, which scrolls by itself where it is too wide for a page."""
    label = escape(node.astext()[:200], quote=True)
    formula = _written(node, True)
    writer.body.append(f'<div class="math" tabindex="0" role="group" aria-label="{label}">{formula}</div>\n')
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, bool]:
    """Register the renderer."""
    app.add_html_math_renderer("mathml", (inline, None), (block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
