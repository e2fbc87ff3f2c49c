"""Machine code of linear systems: with the numbers of a shape as constants, and with numbers read from tables."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from control_variants import VARIANTS, trial_point

from codegen.runtime.kkt import specialised
from codegen.runtime.kkt.specialised import compiled_system, is_made, kept, path_of
from codegen.runtime.search.grid import free_unknowns
from codegen.runtime.search.linear_system import allocate_system, factor_kkt

STEPS = 3


@pytest.mark.parametrize(("name", "text", "choices"), [*VARIANTS[:2], *VARIANTS[-1:], ("two_stage_rocket", None, {})])
def test_constants_change_no_step(interpreted, name, text, choices):
    """The step of Newton's method and the number of negative pivots."""
    module = interpreted(f"{name}_constants" if text else name, text, sensitivities=True, **choices)
    grid = module.make_grid(max(STEPS, module.metadata.inner_times + 2))
    unknowns = trial_point(module, grid, 5, 0.02)
    diagonal = np.where(grid.is_multiplier, 0.0, 1e5)
    normal = np.random.default_rng(2).normal(size=unknowns.size)
    gradient = np.where(free_unknowns(grid), normal, 0.0)

    def step_by(system):
        problem = replace(grid.problem)
        vars(problem)["system"] = system.address
        own = grid._replace(problem=problem)
        step = np.full(unknowns.size, np.nan)
        return factor_kkt(own, unknowns, 1.0, diagonal, allocate_system(own), gradient, step), step

    (count, step), (other, of_tables) = step_by(compiled_system(grid.structure.shape)), step_by(compiled_system(None))
    assert count == other <= 0
    assert step == pytest.approx(of_tables, rel=1e-9, abs=1e-12 * np.abs(step).max())


def test_a_damaged_file_is_made_anew(tmp_path: Path) -> None:
    path = tmp_path / "kkt" / "code.o"
    assert kept(path, lambda: b"machine code") == b"machine code"
    assert kept(path, lambda: b"never made") == b"machine code"
    whole = path.read_bytes()
    for damaged in (whole[:-1], whole.replace(b"machine", b"macaine"), b""):
        path.write_bytes(damaged)
        assert kept(path, lambda: b"machine code") == b"machine code"
        assert path.read_bytes() == whole
    assert [file.name for file in path.parent.iterdir()] == ["code.o"]


def test_another_processor_has_other_machine_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """Folders of the cache may be shared by machines."""
    shape = specialised.Shape(*[1] * 14)
    own = path_of(shape)
    monkeypatch.setattr(specialised.config, "CPU_NAME", "generic")
    assert path_of(shape) != own
    assert not is_made(shape)
