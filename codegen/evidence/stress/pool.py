"""Worker processes that can be killed: a time limit for every build and every case, rows in the order of the cases."""

from __future__ import annotations

import multiprocessing
import os
import queue
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

from codegen.errors import CodegenError
from codegen.evidence.stress.cases import Case, Measurement, Setup


def serve(connection: Connection) -> None:
    """Answer each Setup by None once its module is ready, each Case by its Measurement, until the pipe is closed."""
    warnings.simplefilter("ignore")
    threading.Thread(target=_end_with_parent, daemon=True).start()
    module: Any = None
    refusal, exception = "", ""
    with suppress(EOFError, KeyboardInterrupt):
        while True:
            message = connection.recv()
            answer: Any = None
            if isinstance(message, Setup):
                module, refusal, exception = _made(message)
            elif isinstance(message, Case):
                answer = _measured(module, message) if module is not None else Measurement(
                    refusal=refusal, exception=exception
                )  # fmt: skip
            connection.send(answer)


def _end_with_parent() -> None:
    """End this process, whatever it is doing, when the process that started it has ended, by whatever means."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _made(setup: Setup) -> tuple[Any, str, str]:
    """The compiled module, or what it was refused for, or the exception."""
    from codegen.solving import compiler
    from codegen.solving.loading import load
    from codegen.solving.machine_code.compilation import compile_all

    try:
        arguments = {name: str(value) for name, value in setup.arguments}
        module = load(compiler.build(setup.file, arguments, scheme=setup.scheme, method=setup.method).path)
        compile_all(module)
    except CodegenError as error:
        return None, str(error), ""
    except Exception as error:
        return None, "", described(error)
    return module, "", ""


def _measured(module: Any, case: Case) -> Measurement:
    from codegen.evidence.stress.measure import measure

    try:
        return measure(module, case)
    except CodegenError as error:
        return Measurement(refusal=str(error))
    except Exception as error:
        return Measurement(exception=described(error))


def described(error: Exception) -> str:
    """An exception in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]


BUILD_SECONDS = 600.0
"""The time in which a module must be derived and compiled; these run several at once, on machines of any speed."""
START_SECONDS = 120.0

Report = Callable[[Case, Measurement], None]


@dataclass
class Worker:
    """A process that answers one message with one; `ask` raises TimeoutError or EOFError when it does not."""

    serve: Callable[[Connection], None]

    def __post_init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, other = context.Pipe()
        self.process = context.Process(target=self.serve, args=(other,), daemon=True)
        self.process.start()
        other.close()

    def ask(self, message: Any, seconds: float) -> Any:
        """The answer to a message within a time limit."""
        self.connection.send(message)
        if not self.connection.poll(seconds):
            raise TimeoutError
        return self.connection.recv()

    def end(self) -> None:
        """End the process, whatever it is doing."""
        self.process.kill()
        self.process.join()
        self.connection.close()


def run(
    cases: Sequence[Case], workers: int, report: Report, serve: Callable[[Connection], None] = serve
) -> list[Measurement]:
    """Measure every case; `report` is called from one thread at a time as soon as a case is measured.

    Cases of one module run one after the other in one process. A process that hangs or dies costs the case at hand
    only: the next one starts in a new process, from the cached module.
    """
    jobs: queue.SimpleQueue[list[int]] = queue.SimpleQueue()
    groups: dict[Setup, list[int]] = {}
    for number, case in enumerate(cases):
        groups.setdefault(case.setup, []).append(number)
    for numbers in groups.values():
        jobs.put(numbers)
    measured: dict[int, Measurement] = {}
    lock = threading.Lock()

    def keep(number: int, measurement: Measurement) -> None:
        with lock:
            measured[number] = measurement
            report(cases[number], measurement)

    def work() -> None:
        worker: Worker | None = None
        while not jobs.empty():
            try:
                numbers = jobs.get_nowait()
            except queue.Empty:
                break
            worker = _do(worker, iter([(n, cases[n]) for n in numbers]), keep, serve)
        if worker is not None:
            worker.end()

    threads = [threading.Thread(target=work, daemon=True) for _ in range(min(workers, len(groups)))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return [measured.get(number, Measurement(exception="was not run")) for number in range(len(cases))]


def _do(
    worker: Worker | None,
    numbered: Iterator[tuple[int, Case]],
    keep: Callable[[int, Measurement], None],
    serve: Callable[[Connection], None],
) -> Worker | None:
    """Measure the cases of one module; the process that is left, None when the last one had to be ended."""
    built = False
    for number, case in numbered:
        try:
            if worker is None:
                worker, built = Worker(serve), False
                worker.ask(None, START_SECONDS)
            if not built:
                worker.ask(case.setup, BUILD_SECONDS)
                built = True
            measurement = worker.ask(case, case.seconds)
        except TimeoutError:
            text = "" if built else f"not derived and compiled within {BUILD_SECONDS:g} s"
            measurement = Measurement(hung=True, message=text)
        except (EOFError, OSError) as error:
            measurement = Measurement(exception=f"the process died ({type(error).__name__})")
        if measurement.hung or measurement.exception.startswith("the process died"):
            assert worker is not None
            worker.end()
            worker = None
        keep(number, measurement)
        if measurement.hung and not built:
            for other, _ in numbered:  # those that are left, which would wait for the same module
                keep(other, measurement)
    return worker
