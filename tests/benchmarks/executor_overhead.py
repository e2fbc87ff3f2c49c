"""What an executor costs beside the work: chunks that do nothing, and what that makes of a large sweep.

    python tests/benchmarks/executor_overhead.py [--chunks N] [--seconds S] [--bytes B] [--cases N] [--cores N]

Gives N empty chunks (5000) to two processes, and to a cluster of dask with a scheduler and two workers on this machine,
and prints the milliseconds of each chunk: of whoever gives the orders, since nothing else is done. From the seconds and
bytes of a case, by default those of an orbital transfer (N = 100) on two cores of an AMD EPYC, follows what so many
cases (1e8) take on so many cores (1000), in chunks of a second: solving, giving orders, one after the other, and
writing. That the network and the disks keep up is assumed, and not measured.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import time
from dataclasses import dataclass

from control_speed import machine

from codegen.batch.executors import Done, Tally, executor_for

CHUNK = 1.0
"""Seconds of a chunk, as a sweep sizes them."""
DONE = Done(Tally({"solved": 1}, {}, 0.0))


@dataclass(frozen=True)
class Empty:
    """Work whose chunks do nothing."""

    def loaded(self):
        return self

    def parcel(self):
        return self

    is_compiled = False

    def unpacked(self):
        return self, ()

    def piece(self, number):
        return number

    def solve(self, piece, is_wanted=lambda: True):
        return DONE

    def lost(self, number, reason):
        raise RuntimeError(reason)

    def returned(self, number, done):
        return done


def milliseconds_of_chunk(cluster: str | None, chunks: int) -> float:
    """What a chunk takes, by the clock, once workers are ready."""
    work = Empty()
    with executor_for(work, 2, cluster)(work, 2) as solve:
        found = sum(1 for _ in solve(range(100)))
        begin = time.perf_counter()
        found += sum(1 for _ in solve(range(100, 100 + chunks)))
        seconds = time.perf_counter() - begin
    if found != 100 + chunks:
        raise RuntimeError(f"{found} chunks came back of {100 + chunks}")
    return 1e3 * seconds / chunks


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--chunks", type=int, default=5000)
    parser.add_argument("--seconds", type=float, default=0.28e-3, help="of a processor, for a case with all around it")
    parser.add_argument("--bytes", type=float, default=3300.0, help="of a case in the store")
    parser.add_argument("--cases", type=float, default=1e8)
    parser.add_argument("--cores", type=int, default=1000)
    words = parser.parse_args()
    print(machine())
    per_chunk = {
        name: milliseconds_of_chunk(cluster, words.chunks) for name, cluster in (("processes", None), ("dask", "local"))
    }
    for name, value in per_chunk.items():
        print(f"{name:10} {value:6.2f} ms a chunk, {1e3 / value:6.0f} chunks a second")
    solving = words.cases * words.seconds / words.cores
    chunks = words.cases * words.seconds / CHUNK
    orders = 1e-3 * per_chunk["dask"] * chunks
    print(f"{words.cases:.0e} cases on {words.cores} cores, {chunks:.0f} chunks:")
    print(f"solving {solving:.0f} s, giving orders {orders:.0f} s, {1e-9 * words.cases * words.bytes:.0f} GB to write")
    print(f"the bottleneck is {'giving orders' if orders > solving else 'solving'}")


if __name__ == "__main__":
    main()
