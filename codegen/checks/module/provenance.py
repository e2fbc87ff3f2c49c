"""Whether the module on disk is what the problem file generates today."""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from codegen.checks.base import Finding


def compare(file: Path, module: Any, inputs: str, text: str) -> Iterator[Finding]:
    """Compare the recorded hash of the inputs, and the text line by line, with those of a fresh derivation."""
    recorded = module.metadata.inputs
    same = recorded == inputs
    detail = "the recorded hash is that of the problem file, its arguments and versions"
    if not same:
        detail = f"made from other inputs (recorded {str(recorded)[:12]}, now {inputs[:12]}); build it again"
    yield Finding("provenance", "inputs", same, detail)
    difference = first_difference(file.read_text(encoding="utf-8"), text)
    detail = difference or "identical to a fresh derivation, byte by byte"
    yield Finding("provenance", "text", not difference, detail)


def first_difference(found: str, wanted: str) -> str:
    """The first line in which two texts differ, in words; empty when they are the same."""
    if found == wanted:
        return ""
    lines, others = found.splitlines(keepends=True), wanted.splitlines(keepends=True)
    matcher = difflib.SequenceMatcher(None, lines, others, autojunk=False)
    for tag, first, last, start, stop in matcher.get_opcodes():
        if tag == "equal":
            continue
        ours = lines[first].strip() if first < last else "nothing"
        theirs = others[start].strip() if start < stop else "nothing"
        return f"line {first + 1} reads {ours[:120]!r}, expected {theirs[:120]!r}"
    return "the texts differ"
