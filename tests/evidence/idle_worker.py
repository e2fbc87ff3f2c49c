"""A worker process that measures nothing: it answers at once, but sleeps over cases that say so, and dies of others."""

import os
import time

from codegen.evidence.stress.cases import Case, Measurement

SOLVED = Measurement("solved", "all steps", error=1e-4, residual=1e-14, tolerance=1e-10, drift=1e-5)


def serve(connection):
    """Answer each Case by SOLVED, everything else by None."""
    while True:
        message = connection.recv()
        if isinstance(message, Case) and message.name == "sleeps":
            time.sleep(60.0)
        if isinstance(message, Case) and message.name == "dies":
            os._exit(3)
        connection.send(SOLVED if isinstance(message, Case) else None)
