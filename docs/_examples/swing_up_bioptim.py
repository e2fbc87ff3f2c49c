"""The same with bioptim: a biorbd model in a file of its own, collocation, IPOPT through CasADi."""

from pathlib import Path

import numpy
from bioptim import (
    BoundsList,
    DynamicsOptions,
    InitialGuessList,
    InterpolationType,
    Objective,
    ObjectiveFcn,
    OdeSolver,
    OptimalControlProgram,
    Solver,
    TorqueBiorbdModel,
)

Path("pendulum.bioMod").write_text("""version 4
gravity 0 0 -9.81
segment Pendulum
    rotations x
    mass 1
    inertia
        0 0 0
        0 0 0
        0 0 0
    com 0 0 -0.5
endsegment
""")
model = TorqueBiorbdModel("pendulum.bioMod")
bounds, guess, torques = BoundsList(), InitialGuessList(), BoundsList()
bounds["q"] = [[0, -10, numpy.pi]], [[0, 10, numpy.pi]]  # at the start, between, at the end
bounds["qdot"] = [[0, -100, 0]], [[0, 100, 0]]
torques["tau"] = [-100], [100]
guess.add("q", [[0, numpy.pi]], interpolation=InterpolationType.LINEAR)
program = OptimalControlProgram(
    model, n_shooting=100, phase_time=2, x_bounds=bounds, u_bounds=torques, x_init=guess,
    dynamics=DynamicsOptions(ode_solver=OdeSolver.COLLOCATION(polynomial_degree=3, method="legendre")),
    objective_functions=Objective(ObjectiveFcn.Lagrange.MINIMIZE_CONTROL, key="tau"),
)  # fmt: skip
solver = Solver.IPOPT(online_optim=None)
solver.set_print_level(0)
cost = float(program.solve(solver).cost)
print(cost)
