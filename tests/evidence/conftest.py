"""The gallery's modules, made once a session and run uncompiled, and damaged copies of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import pytest
from interpreted import without_compilation

from codegen.emit.naming import Choices
from codegen.evidence import checks
from codegen.evidence.checks.base import Context
from codegen.solving import compiler

PROBLEMS = Path(__file__).parents[2] / "problems"
Prepare = Callable[..., Context]


@pytest.fixture(scope="session")
def prepared(cache_folder: Path) -> Prepare:
    """Contexts by problem file, arguments and choices; each is built once."""
    known: dict[object, Context] = {}

    def prepare(problem: str | Path, arguments: Mapping[str, str] | None = None, **choices: str) -> Context:
        path = PROBLEMS / f"{problem}.py" if isinstance(problem, str) else problem
        key = (path, tuple((arguments or {}).items()), tuple(choices.items()))
        if key not in known:
            made = compiler.build(path, arguments, **choices)
            context = checks.context_of(path, arguments or {}, Choices(**choices), made.path)
            known[key] = replace(context, module=uncompiled(made.path))
        return known[key]

    return prepare


def uncompiled(path: Path):
    """A generated module whose kernels the interpreter runs: checks look at a few intervals only."""
    module = without_compilation(path.read_text(encoding="utf-8"), path.stem)
    module.__file__ = str(path)
    return module


@pytest.fixture
def interpreting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have `checks.run` look at modules that the interpreter runs."""
    monkeypatch.setattr(checks, "load", uncompiled)


@pytest.fixture
def damaged(tmp_path: Path) -> Callable[..., Context]:
    """A context whose module is a copy in which the first occurrence of each text is replaced by the text after it."""

    def damage(context: Context, *texts: str) -> Context:
        text = Path(context.module.__file__).read_text(encoding="utf-8")
        for old, new in zip(texts[::2], texts[1::2], strict=True):
            assert old in text, f"the module does not hold {old!r}"
            text = text.replace(old, new, 1)
        copy = tmp_path / "damaged.py"
        copy.write_text(text, encoding="utf-8")
        return replace(context, module=uncompiled(copy))

    return damage
