"""Planted defects in kernels of particles and in conditions between bodies are found before a module is written."""

import pytest
from planted_defects import changed, prepared_file

from codegen.emit import verify
from codegen.errors import VerificationError

PAIR_DEFECTS = {
    "energy": ("hamiltonian", r"energy \+= (.*)", r"energy += 1.00001*(\1)"),
    "gradient": ("hamiltonian_gradient", r"(gradient\[1, first \+ m, 1\]) = (.*)", r"\1 = 1.00001*(\2)"),
    "Hessian": ("hamiltonian_hessian", r"(hessian\[.*\]) \+= (.*)", r"\1 += 1.001*(\2)"),
    "products": ("hessian_products", r"products\[row_j, c\] \+= ", "products[row_j, c] -= "),
    "momenta": ("momentum_matrix", r"matrix\[i, j\] \+= ", "matrix[i, j] -= "),
}


@pytest.fixture(scope="module")
def of_landmarks():
    return prepared_file("image_registration")


@pytest.mark.parametrize("name", PAIR_DEFECTS)
def test_planted_defect_of_particles_is_found(of_landmarks, name):
    program, text = of_landmarks
    verify.verify(program, text)
    function, pattern, replacement = PAIR_DEFECTS[name]
    with pytest.raises(VerificationError, match="the emitted code gives"):
        verify.verify(program, changed(text, function, pattern, replacement))


def test_products_where_a_term_is_linear_in_an_invariant():
    """p^2/(2 m) has no curvature in p^2: products once read a momentum that nothing had read."""
    program, text = prepared_file("lennard_jones")
    verify.verify(program, text)
    with pytest.raises(VerificationError, match="for hessian_products"):
        verify.verify(program, changed(text, *PAIR_DEFECTS["products"]))


COUPLING_DEFECTS = {
    "value": ("coupling_0", r"return (.*)", r"return 1.001*(\1)"),
    "slope": ("coupling_0", r"slopes\[1\] = (.*?)(  #|\n)", r"slopes[1] = -(\1)\2"),
    "curvature": ("coupling_0", r"curvatures\[0\] = (.*?)(  #|\n)", r"curvatures[0] = 3*(\1)\2"),
}


@pytest.fixture(scope="module")
def of_hovercraft():
    return prepared_file("hovercraft")


@pytest.fixture(scope="module")
def of_sensitive_hovercraft():
    return prepared_file("hovercraft", sensitivities=True)


@pytest.mark.parametrize("name", COUPLING_DEFECTS)
def test_planted_defect_of_conditions_between_bodies_is_found(of_hovercraft, name):
    program, text = of_hovercraft
    with pytest.raises(VerificationError, match="of the condition"):
        verify.verify(program, changed(text, *COUPLING_DEFECTS[name]))


@pytest.mark.parametrize(
    ("function", "pattern", "replacement"),
    [
        ("coupling_1_mixed", r"slopes\[3\] = (.*?)(  #|\n)", r"slopes[3] = -(\1)\2"),
        ("coupling_2_mixed", r"slopes\[4\]", "slopes[5]"),
    ],
)
def test_planted_defect_of_data_of_conditions_is_found(of_sensitive_hovercraft, function, pattern, replacement):
    program, text = of_sensitive_hovercraft
    verify.verify(program, text)
    with pytest.raises(VerificationError, match="of the condition"):
        verify.verify(program, changed(text, function, pattern, replacement))


def test_a_term_that_reads_another_unknown_is_found(of_hovercraft):
    program, text = of_hovercraft
    verify.verify(program, text)
    assert "COUPLING_INDICES = np.array([[0, 2], " in text
    with pytest.raises(VerificationError, match="the condition"):
        verify.verify(program, text.replace("INDICES = np.array([[0, 2], ", "INDICES = np.array([[0, 3], "))
