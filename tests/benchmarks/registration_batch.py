"""A batch of registrations on one and two workers, through processes and dask, and killed again and again.

    python tests/benchmarks/registration_batch.py [--pairs N] [--kills N] [--seed N] [--only speed|kills]

Makes N pairs (1000) of images of 64 x 64 pixels with 8 landmarks each. Prints the seconds of `codegen warp` for them in
one process, by two processes, and by a cluster of dask with one and two workers; what it takes to begin is told by a
batch in which all pairs are whole. Then has the batch done by a scheduler and two workers that are begun by hand,
while workers and the client are killed (SIGKILL) in turn, N times (20), and begun again, the client with --resume. The
status is 1 if an image differs from that of one process, or a pair that was noted as done has been done again.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import csv
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

from codegen.registration.formats import write_landmarks
from codegen.registration.images import write_image
from codegen.registration.pairs import LandmarkPairs

SIDE, LANDMARKS = 64, 8
SILENT = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
WAYS = {
    "one process": ("--workers", "1"),
    "two processes": ("--workers", "2"),
    "dask, one worker": ("--cluster", "local", "--workers", "1"),
    "dask, two workers": ("--cluster", "local", "--workers", "2"),
}


def make(folder: Path, number: int, seed: int) -> None:
    """Images of waves, each with landmarks that move by about a fiftieth of it."""
    folder.mkdir()
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:SIDE, :SIDE]
    for k in range(number):
        a, b, c, d = rng.uniform(3.0, 9.0, 4)
        write_image(folder / f"{k:05d}.png", (127.0 * (1.0 + np.sin(x / a + b) * np.sin(y / c + d))).astype("u1"))
        places = rng.uniform(0.15 * SIDE, 0.85 * SIDE, (LANDMARKS, 2))
        pairs = LandmarkPairs(places, places + rng.normal(0.0, 0.02 * SIDE, places.shape))
        write_landmarks(folder / f"{k:05d}.csv", pairs=pairs)


def warped(folder: Path, out: Path, *words: str) -> float:
    """Seconds of a batch."""
    begin = time.perf_counter()
    subprocess.run(command(folder, out, *words), check=True, **SILENT)
    return time.perf_counter() - begin


def command(folder: Path, out: Path, *words: str) -> list[str]:
    """The command line of a batch."""
    return [sys.executable, "-m", "codegen", "warp", str(folder), "--out", str(out), *words]


def speed(folder: Path, base: Path, number: int) -> None:
    """Print the seconds of every way."""
    warped(folder, base / "whole", "--workers", "1")  # what has to be compiled is
    for name, words in WAYS.items():
        out = base / name
        seconds, again = warped(folder, out, *words), warped(folder, out, *words, "--resume")
        different = differing(out, base / "whole")
        print(f"{name}: {seconds:.1f} s, {1e3 * seconds / number:.1f} ms a pair, of which {again:.1f} s to begin and to"
              f" find all whole; images that differ from one process: {different}", flush=True)  # fmt: skip


def differing(out: Path, whole: Path) -> int:
    """How many images are missing, are too many, or have other bits."""
    found, wanted = ({path.name: path.read_bytes() for path in place.glob("*.png")} for place in (out, whole))
    return sum(found.get(name) != wanted.get(name) for name in {*found, *wanted})


def dask(kind: str, file: Path, *words: str) -> subprocess.Popen:
    """A scheduler or a worker."""
    call = [sys.executable, "-m", f"distributed.cli.dask_{kind}", "--no-dashboard", "--scheduler-file", str(file)]
    return subprocess.Popen([*call, *words], **SILENT)


def noted(out: Path) -> list[dict[str, str]]:
    """The lines of the journal."""
    journal = out / "summary.csv.journal"
    lines = journal.read_text().splitlines(keepends=True)[1:] if journal.exists() else []
    return [json.loads(line) for line in lines if line.endswith("\n")]


def killed(folder: Path, out: Path, file: Path, kills: int) -> tuple[Counter, int, int]:
    """What was killed, how many pairs were noted twice, and how many images of noted pairs were made once more."""
    scheduler = dask("scheduler", file, "--port", "0")
    while not (file.exists() and file.read_text().rstrip().endswith("}")):
        time.sleep(0.05)
    address = json.loads(file.read_text())["address"]
    parts: dict[str, subprocess.Popen | None] = {"worker 1": None, "worker 2": None, "client": None}
    done, twice, stamps, wanted = Counter[str](), 0, dict[str, int](), 0
    try:
        while parts["client"] is None or parts["client"].poll() != 0:
            for name, part in parts.items():
                if part is None or part.poll() is not None:
                    parts[name] = (
                        subprocess.Popen(command(folder, out, "--cluster", address, "--resume"), **SILENT)
                        if name == "client"
                        else dask("worker", file, "--nthreads", "1", "--no-nanny", "--memory-limit", "0")
                    )
            lines = noted(out)
            if done.total() < kills and len(lines) > wanted:
                time.sleep(random.uniform(0.0, 0.5))
                name = random.choice(list(parts))
                parts[name].send_signal(signal.SIGKILL)
                parts[name].wait()
                done[name.partition(" ")[0]] += 1
                lines = noted(out)
                twice += len(lines) - len({line["out"] for line in lines})
                for line in lines:
                    stamps.setdefault(line["out"], Path(line["out"]).stat().st_mtime_ns)
                wanted = len(lines) + random.randint(1, 40)
            time.sleep(0.02)
    finally:
        for part in (*parts.values(), scheduler):
            if part is not None:
                part.kill()
                part.wait()
    return done, twice, sum(Path(path).stat().st_mtime_ns != stamp for path, stamp in stamps.items())


def main() -> int:
    """Print seconds, and what became of a batch that was killed; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, number in (("pairs", 1000), ("kills", 20), ("seed", 0)):
        parser.add_argument(f"--{name}", type=int, default=number)
    parser.add_argument("--only", choices=("speed", "kills"))
    asked = parser.parse_args()
    random.seed(asked.seed)
    with tempfile.TemporaryDirectory() as place:
        base = Path(place)
        make(base / "in", asked.pairs, asked.seed)
        if asked.only != "kills":
            speed(base / "in", base, asked.pairs)
        if asked.only == "speed":
            return 0
        if not (base / "whole").exists():
            warped(base / "in", base / "whole", "--workers", "1")
        begin = time.perf_counter()
        done, twice, again = killed(base / "in", base / "out", base / "scheduler.json", asked.kills)
        seconds = time.perf_counter() - begin
        with (base / "out" / "summary.csv").open(newline="") as file:
            lines = Counter(line["out"] for line in csv.DictReader(file) if line["status"] == "solved")
        different = differing(base / "out", base / "whole")
        others = sorted({path.name for path in (base / "out").iterdir() if path.suffix != ".png"} - {"summary.csv"})
    is_whole = len(lines) == asked.pairs and set(lines.values()) == {1}
    print(f"{asked.pairs} pairs in {seconds:.0f} s; killed: {dict(done)}")
    print(f"every pair in the summary exactly once, solved: {is_whole}; noted twice: {twice}; done again: {again}")
    print(f"images that differ from one process: {different}; other files beside: {', '.join(others) or 'none'}")
    return 0 if is_whole and not (twice or again or different or others) else 1


if __name__ == "__main__":
    sys.exit(main())
