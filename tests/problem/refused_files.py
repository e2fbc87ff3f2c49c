"""What reading a problem file is refused with."""

from __future__ import annotations

from pathlib import Path

import pytest

from codegen.discretise.model.from_problem import load_problem
from codegen.errors import CodegenError

PROBLEMS = Path(__file__).parents[2] / "problems"


def refusal(file: Path, arguments: dict[str, str] | None = None) -> CodegenError:
    with pytest.raises(CodegenError) as caught:
        load_problem(file, arguments or {})
    message = str(caught.value)
    assert message.startswith(str(file))
    assert message.isprintable()
    assert caught.value.remedy
    return caught.value
