"""The same with dymos: an OpenMDAO component with its partial derivatives, Radau collocation, SLSQP."""

import dymos
import numpy
import openmdao.api as om


class Pendulum(om.ExplicitComponent):
    """Rates of angle, angular velocity and the integral of the squared torque."""

    def initialize(self):
        self.options.declare("num_nodes", types=int)

    def setup(self):
        n = self.options["num_nodes"]
        for name in ("theta", "omega", "torque"):
            self.add_input(name, shape=n)
        for name in ("theta_dot", "omega_dot", "effort_dot"):
            self.add_output(name, shape=n)
        row = numpy.arange(n)
        self.declare_partials("theta_dot", "omega", rows=row, cols=row, val=1)
        self.declare_partials("omega_dot", "theta", rows=row, cols=row)
        self.declare_partials("omega_dot", "torque", rows=row, cols=row, val=1 / (m * l**2))
        self.declare_partials("effort_dot", "torque", rows=row, cols=row)

    def compute(self, inputs, outputs):
        outputs["theta_dot"] = inputs["omega"]
        outputs["omega_dot"] = inputs["torque"] / (m * l**2) - g / l * numpy.sin(inputs["theta"])
        outputs["effort_dot"] = inputs["torque"] ** 2

    def compute_partials(self, inputs, partials):
        partials["omega_dot", "theta"] = -g / l * numpy.cos(inputs["theta"])
        partials["effort_dot", "torque"] = 2 * inputs["torque"]


m, l, g = 1, 0.5, 9.81
problem = om.Problem(model=om.Group(), reports=False)
problem.driver = om.ScipyOptimizeDriver(optimizer="SLSQP", tol=1e-10, maxiter=500, disp=False)
problem.driver.declare_coloring(show_summary=False)
phase = dymos.Phase(ode_class=Pendulum, transcription=dymos.Radau(num_segments=10, order=7))
problem.model.add_subsystem("trajectory", dymos.Trajectory()).add_phase("swing", phase)
phase.set_time_options(fix_initial=True, fix_duration=True)
phase.add_state("theta", rate_source="theta_dot", targets="theta", fix_initial=True, fix_final=True)
phase.add_state("omega", rate_source="omega_dot", targets="omega", fix_initial=True, fix_final=True)
phase.add_state("effort", rate_source="effort_dot", fix_initial=True)
phase.add_control("torque", targets="torque")
phase.add_objective("effort", loc="final")
problem.setup()
phase.set_time_val(0, 2)
phase.set_state_val("theta", [0, numpy.pi])
phase.set_state_val("omega", [0, 0])
phase.set_state_val("effort", [0, 10])
phase.set_control_val("torque", [0, 0])
dymos.run_problem(problem, run_driver=True)
cost = problem.get_val("trajectory.swing.timeseries.effort")[-1, 0]
print(cost)
