"""The guide's examples of other optimisers, as they stand there, against the generated solver."""

from __future__ import annotations

import re

import pytest
from compiled_modules import compiled
from conftest import PROBLEMS

from codegen.solving.compiler import build
from codegen.solving.drivers.quiet import quiet_single_thread

PAGE = PROBLEMS.parent / "docs" / "guide" / "optimisers.md"
EXAMPLES = {
    "SLSQP": ("cart_pole", {}),
    "trust-constr": ("orbital_transfer", {"r1": 5.5}),
    "fsolve": ("orbital_transfer", {}),
    "cyipopt": ("cart_pole", {}),
}


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_find_the_optimum_of_the_generated_solver(name, capsys, folder):
    if name == "cyipopt":
        pytest.importorskip("cyipopt")
    (folder / "problems").symlink_to(PROBLEMS)
    problem, arguments = EXAMPLES[name]
    module = compiled(build(f"problems/{problem}.py").path)
    section = PAGE.read_text(encoding="utf-8").partition(f"## {name}\n")[2].partition("\n## ")[0]
    (block,) = re.findall(r"^```python\n(.*?)^```$", section, re.MULTILINE | re.DOTALL)
    with quiet_single_thread():
        exec(block, {})
    expected = module.solve(20, **arguments)
    assert expected.status == "solved"
    assert float(capsys.readouterr().out.split()[0]) == pytest.approx(expected.cost, rel=1e-6)
