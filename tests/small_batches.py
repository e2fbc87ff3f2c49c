"""Batches of small images that tests register."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from codegen.registration.batch import BatchRequest, outcome_of
from codegen.registration.batch_pairs import Places, jobs_in_folder
from codegen.registration.formats import write_landmarks
from codegen.registration.images import write_image
from codegen.registration.job import Options
from codegen.registration.job import run as run_pair
from codegen.registration.pairs import LandmarkPairs

CORNERS = np.array([[3.0, 4.0], [24.0, 5.0], [5.0, 20.0], [22.0, 18.0], [13.0, 11.0]])


def make(folder: Path, number: int) -> Path:
    """A folder of small images, each with landmarks that move by a pixel or two; the second one is damaged."""
    folder.mkdir()
    random = np.random.default_rng(0)
    for k in range(number):
        write_image(folder / f"{k:03d}.png", (250.0 * random.random((24, 30))).astype("u1"))
        pairs = LandmarkPairs(CORNERS, CORNERS + random.normal(size=CORNERS.shape))
        write_landmarks(folder / f"{k:03d}.csv", pairs=pairs)
    (folder / "001.png").write_bytes((folder / "001.png").read_bytes()[:50])
    return folder


def batch(source: Path, out: Path, run_one=run_pair, **request):
    """A batch of a folder."""
    jobs, _ = jobs_in_folder(source, Places(out), None, ())
    return outcome_of(BatchRequest(jobs, Options(), Places(out), out / "summary.csv", **request), run_one=run_one)
