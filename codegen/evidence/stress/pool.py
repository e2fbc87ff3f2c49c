"""Worker processes for stress cases, which are killed if a build or a case exceeds its time limit."""

from __future__ import annotations

import multiprocessing
import os
import queue
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from types import ModuleType
from typing import Any

from codegen.errors import CodegenError
from codegen.evidence.stress.cases import Case, Measurement, Setup

BUILD_SECONDS = 600.0  # the time limit of a build, also on slow machines and while several builds run at once
START_SECONDS = 120.0

Report = Callable[[Case, Measurement], None]
Serve = Callable[[Connection], None]


def serve(connection: Connection) -> None:
    """Answer each Setup by None once its module is ready, each Case by its Measurement, until the pipe is closed."""
    warnings.simplefilter("ignore")
    threading.Thread(target=end_with_parent, daemon=True).start()
    from codegen.evidence.stress.measure import measure
    from codegen.solving import compiler
    from codegen.solving.loading import load
    from codegen.solving.machine_code.compilation import compile_all

    module: ModuleType | Measurement = Measurement()  # or the failure of the build
    with suppress(EOFError, KeyboardInterrupt):
        while True:
            message, answer = connection.recv(), None
            try:
                if isinstance(message, Setup):
                    arguments = {name: str(value) for name, value in message.arguments}
                    path = compiler.build(message.file, arguments, scheme=message.scheme, method=message.method).path
                    loaded = load(path)
                    assert isinstance(loaded, ModuleType)
                    compile_all(loaded)
                    module = loaded
                elif isinstance(message, Case):
                    answer = module if isinstance(module, Measurement) else measure(module, message)
            except CodegenError as error:
                answer = Measurement(refusal=str(error))
            except Exception as error:
                answer = Measurement(exception=" ".join(f"{type(error).__name__}: {error}".split())[:300])
            if isinstance(message, Setup) and answer is not None:
                module, answer = answer, None
            connection.send(answer)


def end_with_parent() -> None:
    """Wait until the parent process has ended for any reason, then end this process at once."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


class Worker:
    """A process that answers each message by one message."""

    def __init__(self, serve: Serve) -> None:
        """Start the process, which runs `serve`."""
        context = multiprocessing.get_context("spawn")
        self.connection, other = context.Pipe()
        self.process = context.Process(target=serve, args=(other,), daemon=True)
        self.process.start()
        other.close()

    def ask(self, message: object, seconds: float) -> Any:
        """Return the answer to a message; raise TimeoutError after `seconds`, or EOFError if the process has died."""
        self.connection.send(message)
        if not self.connection.poll(seconds):
            raise TimeoutError
        return self.connection.recv()

    def end(self) -> None:
        """Kill the process."""
        self.process.kill()
        self.process.join()
        self.connection.close()


def run(cases: Sequence[Case], workers: int, report: Report, serve: Serve = serve) -> list[Measurement]:
    """Measure every case by worker processes; return the measurements in the order of the cases.

    `report` is called from one thread at a time as soon as a case is measured. Cases of one module run one after the
    other in one process. If a process hangs or dies, only the current case is lost: the next case starts in a new
    process, from the cached module.
    """
    groups: dict[Setup, list[int]] = {}
    for number, case in enumerate(cases):
        groups.setdefault(case.setup, []).append(number)
    jobs: queue.SimpleQueue[list[int]] = queue.SimpleQueue()
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
        with suppress(queue.Empty):
            while True:
                worker = _measured(worker, iter([(n, cases[n]) for n in jobs.get_nowait()]), keep, serve)
        if worker is not None:
            worker.end()

    threads = [threading.Thread(target=work, daemon=True) for _ in range(min(workers, len(groups)))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return [measured.get(number, Measurement(exception="was not run")) for number in range(len(cases))]


def _measured(
    worker: Worker | None, numbered: Iterator[tuple[int, Case]], keep: Callable[[int, Measurement], None], serve: Serve
) -> Worker | None:
    """Measure the cases of one module, pass each to `keep`, and return the process, or None if it had to be killed."""
    built = False
    for number, case in numbered:
        lost = True
        try:
            if worker is None:
                worker, built = Worker(serve), False
                worker.ask(None, START_SECONDS)
            if not built:
                worker.ask(case.setup, BUILD_SECONDS)
                built = True
            measurement = worker.ask(case, case.seconds)
            lost = False
        except TimeoutError:
            text = "" if built else f"not derived and compiled within {BUILD_SECONDS:g} s"
            measurement = Measurement(hung=True, message=text)
        except (EOFError, OSError) as error:
            measurement = Measurement(exception=f"the process died ({type(error).__name__})")
        if lost:
            assert worker is not None
            worker.end()
            worker = None
        keep(number, measurement)
        if measurement.hung and not built:
            for other, _ in numbered:  # the remaining cases, which need the same module
                keep(other, measurement)
    return worker
