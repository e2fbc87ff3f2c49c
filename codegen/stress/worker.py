"""What a worker process does: makes the module it is told to, and measures one case after the other on it."""

from __future__ import annotations

import multiprocessing
import os
import threading
import warnings
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import Any

from codegen.errors import CodegenError
from codegen.stress.cases import Case, Measurement, Setup


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
    from codegen import compiler
    from codegen.loading import load
    from codegen.machine_code.compilation import compile_all

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
    from codegen.stress.measure import measure

    try:
        return measure(module, case)
    except CodegenError as error:
        return Measurement(refusal=str(error))
    except Exception as error:
        return Measurement(exception=described(error))


def described(error: Exception) -> str:
    """An exception in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]
