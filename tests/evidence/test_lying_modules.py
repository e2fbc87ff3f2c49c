"""Modules that lie are found out, and what they are compared with is right itself."""

import math
from dataclasses import replace

import numpy as np
import pytest
from interpreted import without_compilation
from stress_cases import PLAIN, every_case

from codegen.emit.naming import Choices
from codegen.errors import NumericsError
from codegen.evidence.stress.cases import PROBLEMS as OWN_PROBLEMS
from codegen.evidence.stress.cases import classify, newton_distance
from codegen.evidence.stress.measure import measure
from codegen.evidence.stress.motions import VERLET, oscillation
from codegen.evidence.stress.problems import field_of
from codegen.evidence.stress.systems import frequency, plate_gradient, spectral_radius
from codegen.solving import api
from codegen.solving.compiler import build, generate
from codegen.solving.loading import load


@pytest.fixture(scope="module")
def verlet():
    """The text of the oscillator's Störmer-Verlet module."""
    case = next(c for c in every_case() if c.setup == PLAIN.setup and c.name.endswith("h omega = 0.01"))
    case = replace(case, steps=100, values=(("omega", 100.0), ("duration", 0.01)), limit=False)
    return generate(OWN_PROBLEMS, {"system": "oscillator"}, Choices("stormer-verlet", "hamiltonian")), case


def test_an_honest_module_is_accurate_and_its_limit_is_two(verlet):
    text, case = verlet
    module = without_compilation(text)
    seen = measure(module, replace(case, limit=True))
    assert classify(case, seen).outcome == "accurate", classify(case, seen).text
    assert seen.textbook < 10.0
    assert seen.stable_below == pytest.approx(2.0, rel=1e-5)
    assert spectral_radius(module, "oscillator", 2.1) == pytest.approx(_growth(2.1), rel=1e-6)


def _growth(x):
    """Largest modulus of the roots of z^2 - (2 - x^2) z + 1, Störmer-Verlet's characteristic polynomial."""
    half_trace = abs(1.0 - x * x / 2.0)
    return half_trace + math.sqrt(half_trace**2 - 1.0)


def test_a_consistent_lie_of_all_kernels_is_found_by_the_textbook(verlet):
    text, case = verlet
    assert text.count("omega**2") >= 4
    lying = without_compilation(text.replace("omega**2", "(1.0000001*omega**2)"))
    row = classify(case, measure(lying, case))
    assert row.outcome == "false solved"
    assert "textbook" in row.text
    unasked = measure(lying, replace(case, textbook=False))
    assert classify(case, unasked).outcome == "accurate", "the error alone does not show so small a lie"


def test_a_large_lie_is_found_by_the_closed_form(verlet):
    text, case = verlet
    lying = without_compilation(text.replace("omega**2", "(1.5*omega**2)"))
    row = classify(case, measure(lying, replace(case, textbook=False)))
    assert row.outcome == "false solved"


def test_a_lie_of_the_steps_alone_is_no_success(verlet):
    text, case = verlet
    begin = text.index("def explicit_step(")
    end = text.index("def ", begin + 1)
    lying = text[:begin] + text[begin:end].replace("omega**2", "(1.5*omega**2)") + text[end:]
    assert lying != text
    row = classify(case, measure(without_compilation(lying), case))
    assert not row.passed


def test_numbers_that_are_none_are_refused_by_name(verlet):
    text, case = verlet
    module = without_compilation(text)
    with pytest.raises(NumericsError, match="finite"):
        measure(module, replace(case, values=(("omega", math.nan),)))


def test_a_prescribed_value_beyond_its_bound_is_refused():
    module = without_compilation(generate(OWN_PROBLEMS, {"system": "walled_cart"}, Choices()))
    walled = [replace(case, steps=6) for case in every_case() if case.setup.problem == "walled_cart"]
    behind = next(case for case in walled if case.name == "cart, wall behind the start")
    seen = measure(module, behind)
    assert seen.status == "infeasible"
    assert "x is prescribed as 0 at the start, beyond its bounds -inf to -0.1" in seen.message
    open_way = replace(behind, values=(("wall", 1.0),))
    assert measure(module, open_way).status == "solved"


def test_a_step_of_particles_that_fails_is_named():
    case = next(case for case in every_case() if case.name == "two bodies at the same place")
    module = load(build(case.setup.file, dict(case.setup.arguments), scheme=case.setup.scheme).path)
    seen = measure(module, replace(case, steps=4))
    assert classify(case, seen).outcome == "refused"
    assert "step 1 of 4, from t = 0 to 0.25" in seen.message


def test_a_flat_arc_along_a_wall_is_optimal():
    """The cost by IPOPT of CasADi at tolerance 1e-12; a cart that leaves the wall by 0.036 costs 1.5e-4 more."""
    module = load(build(OWN_PROBLEMS, {"system": "walled_cart"}).path)
    result = api.solve(module, "newton", steps=6000, parameters={"wall": 1e-3})
    assert result.solved
    assert result.cost == pytest.approx(444.78764598, rel=1e-6)
    assert result.q.min() > -1e-3


def test_the_distance_from_the_root_is_that_of_a_shifted_optimum():
    """The problem is linear-quadratic: one Newton step leads back, whatever the unknowns."""
    module = without_compilation(generate(OWN_PROBLEMS, {"system": "linear_regulator"}, Choices()))
    solved = api.solve(module, "newton", steps=8)
    assert newton_distance(module, solved) < 1e-14
    shifted = solved.unknowns.copy()
    (column,) = np.flatnonzero(np.array(module.metadata.node) == "x")
    stride = module.problem.structure.stride
    shifted[column + 3 * stride] += 1e-4 * np.abs(shifted[column::stride]).max()
    assert newton_distance(module, replace(solved, unknowns=shifted)) == pytest.approx(1e-4, rel=0.01)


# ---- References ----


@pytest.mark.parametrize("problem", ["oscillator", "spring_pendulum", "fput", "rod_chain", "kepler"])
def test_forces_of_references_are_those_of_the_generated_energy(problem):
    """Against the gradient of the generated energy, by complex-free central differences."""
    module = without_compilation(generate(OWN_PROBLEMS, {"system": problem}, Choices("explicit-euler", "hamiltonian")))
    grid = module.make_grid(1)
    random = np.random.default_rng(3)
    q, p = 1.0 + 0.1 * random.standard_normal((2, len(grid.start) // 2))
    values = dict(module.metadata.parameters)
    for i in range(len(q)):
        step = np.zeros(2 * len(q))
        step[i] = 1e-5
        state = np.concatenate([q, p])
        high, low = (module.energy(state + s * step, 0.0, grid.parameters) for s in (1.0, -1.0))
        assert field_of(problem)(values, state)[len(q) + i] == pytest.approx(-(high - low) / 2e-5, rel=1e-6, abs=1e-6)


def test_the_plates_gradient_is_that_of_its_hamiltonian():
    q = np.array([[0.1, 0.2], [-0.3, 0.1], [0.0, -0.6]])
    p = np.array([[1.0, -0.5], [0.3, 0.2], [-0.7, 0.4]])

    def energy(q, p):
        total = 0.0
        for x, u in zip(q, p, strict=True):
            for y, v in zip(q, p, strict=True):
                ab, s = (1 - x @ x) * (1 - y @ y), (x - y) @ (x - y)
                total += (u @ v) * (ab / 2 - (s / 2 * np.log1p(ab / s) if s else 0.0)) / 2
        return total

    by_place, by_momentum = plate_gradient(q, p)
    for i, k in np.ndindex(3, 2):
        step = np.zeros((3, 2))
        step[i, k] = 1e-6
        assert by_place[i, k] == pytest.approx((energy(q + step, p) - energy(q - step, p)) / 2e-6, abs=1e-8)
        assert by_momentum[i, k] == pytest.approx((energy(q, p + step) - energy(q, p - step)) / 2e-6, abs=1e-8)


def test_frequencies_and_swings_of_energy():
    assert frequency("spring_pendulum", {"k": 1e4}) == 100.0
    assert oscillation(VERLET, 1.9) == pytest.approx(1.1 * 0.95**2, rel=1e-5)
