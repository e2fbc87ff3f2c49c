"""Other programs on the problem of a report, where they are installed: CasADi with IPOPT, and with fatrop.

CasADi uses multiple shooting by rk4. With a control u_k that is constant on each interval, and the Runge-Kutta method
rk4 for states and cost,

    minimise    sum_k (cost of step k) + terminal cost
    subject to  x_{k+1} - F(x_k, u_k, t_k, h) = 0,  prescribed states at both ends,  bounds on states and controls

The right-hand sides are those of the author's problem, printed by sympy for CasADi. States are coordinates with
velocities or momenta. The unknowns are x_0, u_0, x_1, ..., x_N, and the constraints of a node follow those of its
interval, as fatrop needs them. A process of its own runs each peer. So neither sympy nor CasADi disturbs other
measurements, and a solve without an end is killed.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
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
    """A solver of CasADi: its name on the page, its name in CasADi, and its options."""

    name: str
    solver: str
    options: Values
    order: int = 4


PEERS = (
    Peer("CasADi + IPOPT, rk4", "ipopt",
         {"ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-10, "ipopt.max_iter": 1000}),
    Peer("CasADi + fatrop, rk4", "fatrop",
         {"structure_detection": "auto", "fatrop": {"print_level": 0, "tolerance": 1e-10, "max_iter": 1000}}),
)  # fmt: skip
"""The peers; one that is not installed, or whose solver this CasADi has not, has no curve."""
ANSWER_SECONDS = 15.0
"""The time after which a solve, with its derivation, has no end: fatrop may repeat a step for ever."""
_ABSENT = ("path", "integrals", "inner_conditions", "start_conditions", "end_conditions", "holonomic", "rolling",
           "periodic", "joined", "delays", "free_parameters", "phases", "measurements")  # fmt: skip
"""Features of a model that the program has not."""


def installed() -> tuple[Peer, ...]:
    """Return the peers that may be measured."""
    return PEERS if find_spec("casadi") is not None else ()


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
    with suppress(EOFError, KeyboardInterrupt):
        while True:
            match connection.recv():
                case None:
                    connection.send(None)
                case Peer() as peer, Path() as problem:
                    try:
                        program = _Program(peer, load_problem(problem, {}))
                        connection.send(None)
                    except (CodegenError, NotImplementedError, NameError, TypeError, AttributeError) as error:
                        connection.send(str(error))
                case Guess() as guess, float() as budget:
                    assert program is not None
                    connection.send(program.row(guess, budget))


class _Program:
    """The dynamics and the cost of a problem as functions of CasADi, for the solver of a peer."""

    def __init__(self, peer: Peer, model: Any) -> None:
        """Print the right-hand sides; raise NotImplementedError with the feature that the program has not."""
        import sympy

        from codegen.evidence.analysis.maximum_principle import dynamics_of

        features = [name for name in _ABSENT if getattr(model, name)] + (["bodies"] if model.bodies > 1 else [])
        if features:
            raise NotImplementedError(f"no program for problems with {', '.join(features).replace('_', ' ')}")
        self.ca, self.peer, self.model = import_module("casadi"), peer, model
        if not self.ca.has_nlpsol(peer.solver):
            raise NotImplementedError(f"this CasADi has no {peer.solver}")
        if hasattr(self.ca.GlobalOptions, "setNumpyMode"):
            self.ca.GlobalOptions.setNumpyMode(-1)  # functions of numpy accept symbols of CasADi without a warning
        self.values = model.default_values
        self.states = (*model.coordinates, *model.rates)
        self.duration = float(model.duration.xreplace(self.values))
        arguments = (*self.states, *model.controls, model.time)

        def printed(expressions: Sequence[Any], module: Any) -> Callable[..., Any]:
            numeric = [expression.xreplace(self.values) for expression in expressions]
            return sympy.lambdify(arguments, numeric, modules=module, cse=True)  # type: ignore[no-any-return]

        self.rates = printed([*dynamics_of(model), model.cost], self.ca)
        self.terminal_cost = printed([model.terminal_cost], self.ca)
        momenta = model.rates if model.form == "hamiltonian" else [model.function.diff(v) for v in model.rates]
        self.momenta = printed(momenta, "numpy")

    def row(self, guess: Guess, budget: float) -> tuple[Values, Trajectory | None]:
        """Return the solve from a guess, with its time if it is solved, and its trajectory."""
        run = self.on_grid(guess)
        with quiet_single_thread():
            solution, status, iterations = run()
            row: Values = {"steps": len(guess.u), "status": status, "iterations": iterations}
            if status != "solved":
                return row, None
            time = timed(run, budget)
        row = {**row, "cost": float(solution["f"]), "seconds": time.processor, "wall seconds": time.wall}
        return row, self.trajectory(np.asarray(solution["x"]).ravel(), len(guess.u))

    def on_grid(self, guess: Guess) -> Callable[[], tuple[Any, str, int]]:
        """Return the function that solves from a guess; it returns the solution, the status and the iterations."""
        ca, model, n, m, steps = self.ca, self.model, len(self.states), len(self.model.controls), len(guess.u)
        h = self.duration / steps
        x, u, t = ca.SX.sym("x", n), ca.SX.sym("u", m), ca.SX.sym("t")

        def rate(state: Any, time: Any) -> Any:
            return ca.vertcat(*self.rates(*ca.vertsplit(state[:n]), *ca.vertsplit(u), time))

        state = ca.vertcat(x, 0)
        first = rate(state, t)
        second = rate(state + h / 2 * first, t + h / 2)
        third = rate(state + h / 2 * second, t + h / 2)
        end = state + h / 6 * (first + 2 * second + 2 * third + rate(state + h * third, t + h))
        step = ca.Function("step", [x, u, t], [end[:n], end[n]], {"cse": True})
        w = ca.MX.sym("w", (n + m) * steps + n)
        table, last = ca.reshape(w[: (n + m) * steps], n + m, steps), w[(n + m) * steps :]
        following, costs = step.map(steps)(table[:n, :], table[n:, :], ca.DM(h * np.arange(steps)).T)
        gaps = ca.horzcat(table[:n, 1:], last) - following
        final = self.terminal_cost(*ca.vertsplit(last), *[0] * m, self.duration)[0]
        rates = guess.p
        if model.form == "lagrangian":
            rates = np.gradient(guess.q, h, axis=0)
        nodes = np.hstack([guess.q, rates])
        low, high = np.full((steps + 1, n + m), -inf), np.full((steps + 1, n + m), inf)
        names = (*self.states, *model.controls)
        for bound in model.bounds:
            for side, limit in ((low, bound.lower), (high, bound.upper)):
                if limit is not None:
                    side[:, names.index(bound.symbol)] = float(limit.xreplace(self.values))
        prescribed = []
        for node, boundary, symbols in ((0, model.start, table[:n, 0]), (-1, model.end, last)):
            given = {i: value for i, value in enumerate((*boundary.positions, *boundary.rates)) if value is not None}
            nodes[node, list(given)] = values = [float(value.xreplace(self.values)) for value in given.values()]
            low[node, list(given)], high[node, list(given)] = -inf, inf
            prescribed.append(symbols[list(given)] - ca.DM(values))
        begin = np.append(np.hstack([nodes[:-1], guess.u]).ravel(), nodes[-1])
        lower, upper = (side.ravel()[: begin.size] for side in (low, high))
        constraints = ca.vertcat(gaps[:, 0], prescribed[0], ca.vec(gaps[:, 1:]), prescribed[1])
        options = {"print_time": False, "expand": True, "error_on_fail": False, **self.peer.options}
        if self.peer.solver == "fatrop":
            options["equality"] = [True] * constraints.numel()
        nlp = {"x": w, "f": ca.sum2(costs) + final, "g": constraints}
        solver = ca.nlpsol("solver", self.peer.solver, nlp, options)
        solve = partial(solver, x0=begin, lbx=lower, ubx=upper, lbg=0.0, ubg=0.0)

        def run() -> tuple[Any, str, int]:
            solution, statistics = solve(), solver.stats()
            status = "solved" if statistics["success"] else str(statistics["return_status"])
            return solution, status, int(statistics["iter_count"])

        return run

    def trajectory(self, unknowns: Vector, steps: int) -> Trajectory:
        """Return states (q, p) at the nodes and controls at the midpoints of a solution."""
        n, m, half = len(self.states), len(self.model.controls), len(self.model.coordinates)
        table = unknowns[: (n + m) * steps].reshape(steps, n + m)
        states, controls = np.vstack([table[:, :n], unknowns[(n + m) * steps :]]), table[:, n:]
        times = np.linspace(0.0, self.duration, steps + 1)
        momenta = self.momenta(*states.T, *np.zeros((m, 1)), times)
        columns = [states[:, :half], *(np.broadcast_to(p, times.shape)[:, None] for p in momenta)]
        fractions = np.linspace(0.0, 1.0, steps + 1)
        return Trajectory(self.duration, fractions, np.hstack(columns), fractions[:-1] + 0.5 / steps, controls)
