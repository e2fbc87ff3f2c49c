"""Other programs on the problem of a report, where they are installed: CasADi with IPOPT or fatrop, opty, and dymos.

All programs have the same unknowns: states x, which are coordinates with velocities or momenta, and controls u. The
right-hand sides and the cost are those of the author's problem.

CasADi uses multiple shooting. With a control u_k that is constant on each interval, and one step F of the Runge-Kutta
method rk4 for states and cost,

    minimise    sum_k (cost of step k) + terminal cost
    subject to  x_{k+1} - F(x_k, u_k, t_k, h) = 0,  prescribed states at both ends,  bounds on states and controls

The unknowns are x_0, u_0, x_1, ..., x_N, and the constraints of a node follow those of its interval, as fatrop needs
them. opty replaces the equations of motion by the midpoint rule, with controls at nodes, and calls IPOPT with an
approximate Hessian, which reaches no smaller tolerance than 1e-8. Its functions are those of numpy, since a C compiler
takes more than ten seconds for each grid. dymos collocates at three Radau points on each interval, where controls are
quadratic, and calls SLSQP of scipy.

A process of its own runs each peer. So neither sympy nor the peer disturbs other measurements, and a solve without an
end is killed.
"""

from __future__ import annotations

import io
import os
import tempfile
import threading
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr, suppress
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from math import inf
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from codegen.errors import CodegenError
from codegen.evidence.report.building import timed
from codegen.evidence.report.reference import Trajectory, read_trajectory
from codegen.evidence.report.store import Values
from codegen.evidence.stress.pool import START_SECONDS, Worker, end_with_parent
from codegen.solving.drivers.quiet import quiet_single_thread
from codegen.solving.loading import Matrix, Vector


@dataclass(frozen=True)
class Peer:
    """Another program: its name on the page, its package, its class, its order, its solver and the solver's options."""

    name: str
    package: str
    program: type[_Program]
    order: int
    solver: str
    options: Values


ANSWER_SECONDS = 15.0
"""The time after which a solve, with its derivation, has no end: fatrop may repeat a step for ever."""
_ABSENT = ("path", "integrals", "inner_conditions", "start_conditions", "end_conditions", "holonomic", "rolling",
           "periodic", "joined", "delays", "free_parameters", "phases", "measurements")  # fmt: skip
"""Features of a model that the programs have not."""


@dataclass(frozen=True)
class Guess:
    """The initial guess on a grid: coordinates and momenta (N + 1, n) at nodes, and controls (N, m) on intervals."""

    q: Matrix
    p: Matrix
    u: Matrix


def measured(
    peer: Peer, problem: Path, guesses: Sequence[Guess], reference: Values, limit: float, budget: float
) -> Values:
    """Return the solves on the grids of the guesses, in rows with times and errors; or the reason for none.

    No grid follows a solve of more than `limit` seconds. A solve is repeated for at most `budget` seconds.
    """
    trajectory, rows = read_trajectory(reference), list[Values]()
    worker = Worker(_serve)
    try:
        worker.ask(None, START_SECONDS)
        message = worker.ask((peer, problem), START_SECONDS)
        if message is not None:
            return {"rows": rows, "message": message}
        for guess in guesses:
            row, found = worker.ask((guess, budget), ANSWER_SECONDS + budget)
            rows.append(row if found is None else {**row, **trajectory.errors(found)})
            if row.get("seconds", 0.0) > limit:
                break
    except TimeoutError:
        rows.append({"steps": len(guess.u), "status": f"no end within {ANSWER_SECONDS:g} s", "iterations": None})
    except (EOFError, OSError):
        rows.append({"steps": len(guess.u), "status": "the process died", "iterations": None})
    finally:
        worker.end()
    return {"rows": rows}


def _serve(connection: Connection) -> None:
    """Answer a peer with a problem by None or the reason for no program, and a guess with a budget by a row."""
    warnings.simplefilter("ignore")
    threading.Thread(target=end_with_parent, daemon=True).start()
    from codegen.discretise.model.from_problem import load_problem

    program: _Program | None = None
    with tempfile.TemporaryDirectory() as folder, suppress(EOFError, KeyboardInterrupt):
        while True:
            match connection.recv():
                case None:
                    connection.send(None)
                case Peer() as peer, Path() as problem:
                    try:
                        model = load_problem(problem, {})
                        reason = peer.program.unsuited(peer, model)
                        if not reason:
                            os.chdir(folder)  # dymos and opty write files
                            program = peer.program(peer, model)
                        connection.send(reason or None)
                    except (CodegenError, ImportError, NameError, TypeError, AttributeError) as error:
                        connection.send(str(error))
                case Guess() as guess, float() as budget:
                    assert program is not None
                    connection.send(program.row(guess, budget))


@dataclass(frozen=True)
class _Found:
    """The end of a solve: its status and iterations, the cost, states at fractions of the duration, and controls."""

    status: str
    iterations: int
    cost: float
    nodes: Vector
    states: Matrix
    times: Vector
    controls: Matrix


class _Program(ABC):
    """The dynamics and the cost of a problem with numbers for its parameters, and their program by a peer."""

    @staticmethod
    def unsuited(peer: Peer, model: Any) -> str:
        """Return the reason why the program does not take a model, or an empty text."""
        features = [name for name in _ABSENT if getattr(model, name)] + (["bodies"] if model.bodies > 1 else [])
        return f"no program for problems with {', '.join(features).replace('_', ' ')}" if features else ""

    def __init__(self, peer: Peer, model: Any) -> None:
        """Read the model, which must suit the program."""
        from codegen.evidence.analysis.maximum_principle import dynamics_of

        self.peer, self.model, values = peer, model, model.default_values
        self.states, self.controls = (*model.coordinates, *model.rates), tuple(model.controls)
        self.symbols = (*self.states, *self.controls, model.time)
        self.duration = float(model.duration.xreplace(values))
        self.rates = [rate.xreplace(values) for rate in dynamics_of(model)]
        self.cost, self.terminal_cost = model.cost.xreplace(values), model.terminal_cost.xreplace(values)
        names = self.symbols[:-1]
        self.low, self.high = np.full(len(names), -inf), np.full(len(names), inf)
        for bound in model.bounds:
            for side, limit in ((self.low, bound.lower), (self.high, bound.upper)):
                if limit is not None:
                    side[names.index(bound.symbol)] = float(limit.xreplace(values))
        self.start, self.end = (
            {i: float(v.xreplace(values)) for i, v in enumerate((*end.positions, *end.rates)) if v is not None}
            for end in (model.start, model.end)
        )
        momenta = model.rates if model.form == "hamiltonian" else [model.function.diff(v) for v in model.rates]
        self.momenta = self.printed([p.xreplace(values) for p in momenta], "numpy")

    def printed(self, expressions: Sequence[Any], module: Any) -> Callable[..., Any]:
        """Return expressions as a function of states, controls and time in the language of a module."""
        import sympy

        return sympy.lambdify(self.symbols, expressions, modules=module, cse=True)  # type: ignore[no-any-return]

    @abstractmethod
    def on_grid(self, nodes: Matrix, u: Matrix) -> Callable[[], Callable[[], _Found]]:
        """Return the function that solves from states (N + 1, n) at nodes and controls (N, m) on intervals.

        It returns a function that reads the result, which takes no part in the measured time.
        """

    def row(self, guess: Guess, budget: float) -> tuple[Values, Trajectory | None]:
        """Return the solve from a guess, with its time if it is solved, and its trajectory."""
        steps, rates = len(guess.u), guess.p
        if self.model.form == "lagrangian":
            rates = np.gradient(guess.q, self.duration / steps, axis=0)
        nodes = np.hstack([guess.q, rates])
        for node, prescribed in ((0, self.start), (-1, self.end)):
            nodes[node, list(prescribed)] = list(prescribed.values())
        with quiet_single_thread():
            run = self.on_grid(nodes, guess.u)
            found = run()()
            row: Values = {"steps": steps, "status": found.status, "iterations": found.iterations}
            if found.status != "solved":
                return row, None
            time = timed(run, budget)
        row = {**row, "cost": found.cost, "seconds": time.processor, "wall seconds": time.wall}
        none = np.zeros((len(self.controls), 1))
        momenta = self.momenta(*found.states.T, *none, self.duration * found.nodes)
        half = len(self.model.coordinates)
        columns = [found.states[:, :half], *(np.broadcast_to(p, found.nodes.shape)[:, None] for p in momenta)]
        return row, Trajectory(self.duration, found.nodes, np.hstack(columns), found.times, found.controls)


class _Casadi(_Program):
    """Multiple shooting by rk4 with a solver of CasADi."""

    @staticmethod
    def unsuited(peer: Peer, model: Any) -> str:
        """Return the reason of `_Program.unsuited`, or that CasADi was built without the solver."""
        lacking = "" if import_module("casadi").has_nlpsol(peer.solver) else f"this CasADi has no {peer.solver}"
        return _Program.unsuited(peer, model) or lacking

    def __init__(self, peer: Peer, model: Any) -> None:
        """Print the right-hand sides."""
        super().__init__(peer, model)
        self.ca = import_module("casadi")
        if hasattr(self.ca.GlobalOptions, "setNumpyMode"):
            self.ca.GlobalOptions.setNumpyMode(-1)  # functions of numpy accept symbols of CasADi without a warning
        self.rates_and_cost = self.printed([*self.rates, self.cost], self.ca)
        self.final = self.printed([self.terminal_cost], self.ca)

    def on_grid(self, nodes: Matrix, u: Matrix) -> Callable[[], Callable[[], _Found]]:
        """Return the function that solves from a guess; the guess of controls is that of intervals."""
        ca, n, m, steps = self.ca, len(self.states), len(self.controls), len(u)
        h = self.duration / steps
        x, control, t = ca.SX.sym("x", n), ca.SX.sym("u", m), ca.SX.sym("t")

        def rate(state: Any, time: Any) -> Any:
            return ca.vertcat(*self.rates_and_cost(*ca.vertsplit(state[:n]), *ca.vertsplit(control), time))

        state = ca.vertcat(x, 0)
        first = rate(state, t)
        second = rate(state + h / 2 * first, t + h / 2)
        third = rate(state + h / 2 * second, t + h / 2)
        end = state + h / 6 * (first + 2 * second + 2 * third + rate(state + h * third, t + h))
        step = ca.Function("step", [x, control, t], [end[:n], end[n]], {"cse": True})
        w = ca.MX.sym("w", (n + m) * steps + n)
        table, last = ca.reshape(w[: (n + m) * steps], n + m, steps), w[(n + m) * steps :]
        following, costs = step.map(steps)(table[:n, :], table[n:, :], ca.DM(h * np.arange(steps)).T)
        gaps = ca.horzcat(table[:n, 1:], last) - following
        final = self.final(*ca.vertsplit(last), *[0] * m, self.duration)[0]
        low, high = np.tile(self.low, (steps + 1, 1)), np.tile(self.high, (steps + 1, 1))
        prescribed = []
        for node, given, symbols in ((0, self.start, table[:n, 0]), (-1, self.end, last)):
            low[node, list(given)], high[node, list(given)] = -inf, inf
            prescribed.append(symbols[list(given)] - ca.DM(list(given.values())))
        begin = np.append(np.hstack([nodes[:-1], u]).ravel(), nodes[-1])
        lower, upper = (side.ravel()[: begin.size] for side in (low, high))
        constraints = ca.vertcat(gaps[:, 0], prescribed[0], ca.vec(gaps[:, 1:]), prescribed[1])
        options = {"print_time": False, "expand": True, "error_on_fail": False, **self.peer.options}
        if self.peer.solver == "fatrop":
            options["equality"] = [True] * constraints.numel()
        nlp = {"x": w, "f": ca.sum2(costs) + final, "g": constraints}
        solver = ca.nlpsol("solver", self.peer.solver, nlp, options)

        def run() -> Callable[[], _Found]:
            solution, statistics = solver(x0=begin, lbx=lower, ubx=upper, lbg=0.0, ubg=0.0), solver.stats()

            def found() -> _Found:
                status = "solved" if statistics["success"] else str(statistics["return_status"])
                unknowns = np.asarray(solution["x"]).ravel()
                values, ends = unknowns[: (n + m) * steps].reshape(steps, n + m), unknowns[(n + m) * steps :]
                fractions, states = np.linspace(0.0, 1.0, steps + 1), np.vstack([values[:, :n], ends])
                return _Found(
                    status, int(statistics["iter_count"]), float(solution["f"]), fractions, states,
                    fractions[:-1] + 0.5 / steps, values[:, n:],
                )  # fmt: skip

            return found

        return run


class _Opty(_Program):
    """The midpoint rule of opty, with controls at nodes, and IPOPT.

    The cost is that of the trapezoidal rule. By the midpoint rule, a control that alternates from node to node would
    cost nothing.
    """

    @staticmethod
    def unsuited(peer: Peer, model: Any) -> str:
        """Return the reason of `_Program.unsuited`, or that the dynamics depend on time."""
        from codegen.evidence.analysis.maximum_principle import dynamics_of

        reason = _Program.unsuited(peer, model)
        if not reason and any(rate.has(model.time) for rate in dynamics_of(model)):
            reason = "no program of opty for dynamics that depend on time"
        return reason

    def __init__(self, peer: Peer, model: Any) -> None:
        """Write the equations of motion with functions of time, and differentiate the cost."""
        import sympy

        super().__init__(peer, model)
        self.opty = import_module("opty")
        self.time, variables = sympy.Symbol("t"), self.symbols[:-1]
        self.functions = [sympy.Function(f"f{i}")(self.time) for i in range(len(variables))]
        written = dict(zip(variables, self.functions, strict=True))
        states = self.functions[: len(self.states)]
        self.equations = sympy.Matrix(
            [f.diff(self.time) - rate.xreplace(written) for f, rate in zip(states, self.rates, strict=True)]
        )
        costs = self.cost, self.terminal_cost
        self.costs, self.slopes = (
            [self.printed([cost, *(cost.diff(x) for x in variables)][part], "numpy") for cost in costs]
            for part in (slice(1), slice(1, None))
        )

    def objective(self, count: int) -> tuple[Callable[[Vector], float], Callable[[Vector], Vector]]:
        """Return the cost on `count` nodes, and its gradient, as functions of opty's unknowns."""
        weights, times = np.full(count, self.duration / (count - 1)), np.linspace(0.0, self.duration, count)
        weights[[0, -1]] /= 2.0

        def cost(unknowns: Vector) -> float:
            values = unknowns.reshape(-1, count)
            return float(
                np.sum(weights * self.costs[0](*values, times)[0]) + self.costs[1](*values[:, -1], times[-1])[0]
            )

        def gradient(unknowns: Vector) -> Vector:
            values = unknowns.reshape(-1, count)
            slopes = np.array([weights * slope for slope in self.slopes[0](*values, times)])
            slopes[:, -1] += self.slopes[1](*values[:, -1], times[-1])
            return slopes.ravel()

        return cost, gradient

    def on_grid(self, nodes: Matrix, u: Matrix) -> Callable[[], Callable[[], _Found]]:
        """Return the function that solves from a guess; a guess at an inner node is the mean of its intervals."""
        import sympy

        n, count, h = len(self.states), len(nodes), self.duration / len(u)
        states = self.functions[:n]
        ends = [
            states[i].func(at) - sympy.Float(value)
            for at, given in ((0, self.start), (sympy.Float(self.duration), self.end))
            for i, value in given.items()
        ]
        rows = zip(self.functions, self.low, self.high, strict=True)
        problem = self.opty.Problem(
            *self.objective(count), self.equations, states, count, h, instance_constraints=tuple(ends),
            time_symbol=self.time, integration_method="midpoint", backend="numpy",
            bounds={f: (low, high) for f, low, high in rows if low > -inf or high < inf},
        )  # fmt: skip
        for name, value in self.peer.options.items():
            problem.add_option(name, value)
        at_nodes = 0.5 * (np.vstack([u[:1], u]) + np.vstack([u, u[-1:]]))
        begin = np.hstack([nodes, at_nodes]).T.ravel()

        def run() -> Callable[[], _Found]:
            earlier = len(problem.obj_value)
            solution, information = problem.solve(begin)
            iterations = len(problem.obj_value) - earlier - 1

            def found() -> _Found:
                status = "solved" if information["status"] == 0 else information["status_msg"].decode()
                values, fractions = solution.reshape(-1, count), np.linspace(0.0, 1.0, count)
                means = 0.5 * (values[n:, 1:] + values[n:, :-1])  # the controls of the midpoint rule
                return _Found(
                    status, iterations, float(information["obj_val"]), fractions, values[:n].T,
                    0.5 * (fractions[1:] + fractions[:-1]), means.T,
                )  # fmt: skip

            return found

        return run


class _Dymos(_Program):
    """Radau collocation of dymos with three points on each interval, and SLSQP of scipy."""

    @staticmethod
    def unsuited(peer: Peer, model: Any) -> str:
        """Return the reason of `_Program.unsuited`, or that the cost has a terminal part."""
        terminal = "" if model.terminal_cost == 0 else "no program of dymos for a terminal cost"
        return _Program.unsuited(peer, model) or terminal

    def __init__(self, peer: Peer, model: Any) -> None:
        """Differentiate rates and cost."""
        super().__init__(peer, model)
        with redirect_stderr(io.StringIO()):  # OpenMDAO warns about its own names
            self.dymos, self.om = import_module("dymos"), import_module("openmdao.api")
        outputs = [*self.rates, self.cost]
        self.values = self.printed(outputs, "numpy")
        self.pairs = [
            (row, column)
            for row, output in enumerate(outputs)
            for column, symbol in enumerate(self.symbols)
            if output.has(symbol)
        ]
        self.slopes = self.printed([outputs[i].diff(self.symbols[j]) for i, j in self.pairs], "numpy")

    def component(self) -> type:
        """Return the class of the OpenMDAO component: inputs i0, i1, ... and outputs o0, o1, ..."""
        program = self

        class Dynamics(self.om.ExplicitComponent):  # type: ignore[misc, name-defined]
            def initialize(self) -> None:
                self.options.declare("num_nodes", types=int)

            def setup(self) -> None:
                nodes = self.options["num_nodes"]
                for i in range(len(program.symbols)):
                    self.add_input(f"i{i}", shape=nodes)
                for i in range(len(program.states) + 1):
                    self.add_output(f"o{i}", shape=nodes)
                for i, j in program.pairs:
                    self.declare_partials(f"o{i}", f"i{j}", rows=np.arange(nodes), cols=np.arange(nodes))

            def arguments(self, inputs: Any) -> Iterator[Vector]:
                return (inputs[f"i{i}"] for i in range(len(program.symbols)))

            def compute(self, inputs: Any, outputs: Any) -> None:
                for i, value in enumerate(program.values(*self.arguments(inputs))):
                    outputs[f"o{i}"] = value

            def compute_partials(self, inputs: Any, partials: Any) -> None:
                slopes = program.slopes(*self.arguments(inputs))
                for (i, j), value in zip(program.pairs, slopes, strict=True):
                    partials[f"o{i}", f"i{j}"] = value

        return Dynamics

    def on_grid(self, nodes: Matrix, u: Matrix) -> Callable[[], Callable[[], _Found]]:
        """Return the function that solves from a guess, which is linear between nodes and between midpoints."""
        steps, n = len(u), len(self.states)
        problem = self.om.Problem(model=self.om.Group(), reports=False)
        problem.driver = self.om.ScipyOptimizeDriver(optimizer=self.peer.solver, **self.peer.options)
        problem.driver.declare_coloring(show_summary=False)
        transcription = self.dymos.Radau(num_segments=steps, order=3)
        phase = self.dymos.Phase(ode_class=self.component(), transcription=transcription)
        problem.model.add_subsystem("trajectory", self.dymos.Trajectory()).add_phase("motion", phase)
        phase.set_time_options(fix_initial=True, fix_duration=True, targets=f"i{len(self.symbols) - 1}")
        limits = [
            {side: value for side, value in (("lower", low), ("upper", high)) if np.isfinite(value)}
            for low, high in zip(self.low, self.high, strict=True)
        ]
        for i in range(n):
            phase.add_state(
                f"x{i}", rate_source=f"o{i}", targets=f"i{i}", fix_initial=i in self.start, fix_final=i in self.end,
                **limits[i],
            )  # fmt: skip
        for i in range(len(self.controls)):
            phase.add_control(f"u{i}", targets=f"i{n + i}", continuity=False, rate_continuity=False, **limits[n + i])
        phase.add_state("cost", rate_source=f"o{n}", fix_initial=True)
        phase.add_objective("cost", loc="final")
        problem.setup()
        times = np.linspace(0.0, self.duration, steps + 1)
        middles = np.concatenate([times[:1], 0.5 * (times[1:] + times[:-1]), times[-1:]])

        def run() -> Callable[[], _Found]:
            phase.set_time_val(0.0, self.duration)
            phase.set_state_val("cost", [0.0, 0.0])
            for i in range(n):
                phase.set_state_val(f"x{i}", nodes[:, i], times)
            for i in range(len(self.controls)):
                phase.set_control_val(f"u{i}", np.concatenate([u[:1, i], u[:, i], u[-1:, i]]), middles)
            self.dymos.run_problem(problem, run_driver=True)

            def found() -> _Found:
                result = problem.driver.result

                def values(name: str) -> Vector:
                    return np.asarray(problem.get_val(f"trajectory.motion.timeseries.{name}")).ravel()

                fractions, index = np.unique(values("time") / self.duration, return_index=True)
                tables = [
                    [values(f"{kind}{i}")[index] for i in range(size)] for kind, size in (("x", n), ("u", u.shape[1]))
                ]
                status = "solved" if result.success else str(result.exit_status)
                x, controls = (np.column_stack(table) for table in tables)
                return _Found(status, int(result.iter_count), values("cost")[-1], fractions, x, fractions, controls)

            return found

        return run


TOLERANCE, MOST_ITERATIONS = 1e-10, 1000
PEERS = (
    Peer("CasADi + IPOPT, rk4", "casadi", _Casadi, 4, "ipopt",
         {"ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": TOLERANCE, "ipopt.max_iter": MOST_ITERATIONS}),
    Peer("CasADi + fatrop, rk4", "casadi", _Casadi, 4, "fatrop",
         {"structure_detection": "auto",
          "fatrop": {"print_level": 0, "tolerance": TOLERANCE, "max_iter": MOST_ITERATIONS}}),
    Peer("opty + IPOPT, midpoint", "opty", _Opty, 2, "ipopt",
         {"print_level": 0, "sb": "yes", "tol": 1e-8, "max_iter": MOST_ITERATIONS}),
    Peer("dymos + SLSQP, Radau", "dymos", _Dymos, 5, "SLSQP",
         {"tol": TOLERANCE, "maxiter": MOST_ITERATIONS, "disp": False}),
)  # fmt: skip
"""The peers; one that is not installed, or whose solver this CasADi has not, has no curve."""


def installed() -> tuple[Peer, ...]:
    """Return the peers that may be measured."""
    return tuple(peer for peer in PEERS if find_spec(peer.package) is not None)
