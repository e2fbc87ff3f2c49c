"""One registration from files to files, of pictures or of volumes: what the moving image is decides."""

from __future__ import annotations

from collections.abc import Callable

from codegen.registration import job as pictures
from codegen.registration.jobs import Job, Options, Outcome
from codegen.registration.volumes import job as volumes
from codegen.registration.volumes.files import is_volume


def run(job: Job, options: Options, progress: Callable[[str], None] | None = None) -> Outcome:
    """Do a job; CodegenError for wrong input, and an outcome that has not passed where the numerics failed."""
    if is_volume(job.moving):
        return volumes.run(job, job.own(options), progress)
    return pictures.run(job, job.own(options), progress=progress)


def dimension_of(job: Job) -> int:
    """3 for volumes, 2 for pictures and for what cannot be read."""
    return 3 if is_volume(job.moving) else 2
