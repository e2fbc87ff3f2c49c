"""Which files of a folder or of a table belong together, pictures or volumes, and where the outputs of each pair go."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from codegen.errors import ArgumentError, one_line
from codegen.files import refused
from codegen.registration.images.codecs import KINDS
from codegen.registration.jobs import Job
from codegen.registration.volumes.files import READ, ending, is_volume
from codegen.registration.warp import Interpolation

MOST_PAIRS = 100_000
_SINGLE, _DOUBLE = (".csv", ".tps"), (".pts", ".mrk.json", ".fcsv")
_TABLE = ("moving", "fixed", "landmarks", "out", "interpolation")
_HEADERS = {".nhdr": ".nrrd"}
"""Kinds of volumes that are read and not written, and what is written instead."""


@dataclass(frozen=True)
class Places:
    """Where the outputs of a batch go: folders, which are made where they are missing."""

    out: Path | None = None
    field: Path | None = None
    report: Path | None = None

    def job(
        self,
        moving: Path,
        landmarks: tuple[Path, ...],
        fixed: Path | None,
        out: Path | None = None,
        interpolation: Interpolation | None = None,
    ) -> Job:
        """The job of one pair; its outputs are named after the moving image unless `out` names the image.

        Fields of pictures are .npz, those of volumes .nii.gz.
        """
        out = out or (self.out or Path()) / f"{_stem(moving)}{_written(moving)}"
        kind = ".nii.gz" if self.field is not None and is_volume(moving) else ".npz"
        field = self.field / f"{_stem(out)}{kind}" if self.field is not None else None
        report = self.report / f"{_stem(out)}.html" if self.report is not None else None
        return Job(moving, landmarks, out, fixed, field, report, interpolation)


def _stem(image: Path) -> str:
    kind = ending(image, READ)
    return image.stem if kind is None else image.name[: -len(kind)]


def _written(image: Path) -> str:
    kind = image.name[len(_stem(image)) :]
    return _HEADERS.get(kind.lower(), kind)


def jobs_in_folder(
    folder: Path, places: Places, fixed: Path | None, landmarks: tuple[Path, ...]
) -> tuple[list[Job], list[Path]]:
    """The images and volumes of a folder with landmark files of the same stem, or with `landmarks` all of them.

    The second list are the images that are left out, because they have none.

    `a.png` or `a.nii.gz` belongs to `a.csv`, `a.tps`, `a.moving.pts` with `a.fixed.pts`, or the same with `.mrk.json`
    or `.fcsv`. `fixed` is one image for all, or a folder with images of the same names. Raises ArgumentError
    where there is no pair, or where it is not clear which files belong together.
    """
    kinds = (*(suffix for known in KINDS.values() for suffix in known), *READ)
    images = sorted(path for path in folder.iterdir() if path.name.lower().endswith(kinds) and path.is_file())
    jobs, without = [], []
    for image in images:
        own = landmarks or _landmarks_of(image)
        if fixed is not None and fixed.is_file() and fixed.samefile(image):
            continue
        if own:
            jobs.append(places.job(image, own, fixed / image.name if fixed is not None and fixed.is_dir() else fixed))
        else:
            without.append(image)
    if not jobs:
        finding = (
            f"{folder} holds {len(images)} image{'s' * (len(images) != 1)}, none with a landmark file of the same name"
        )
        raise ArgumentError(finding, "name landmarks like images, such as a.png and a.csv, or give --landmarks")
    return _distinct(jobs), without


def _landmarks_of(image: Path) -> tuple[Path, ...]:
    """The landmark files that belong to an image; none where there are none."""
    found = [(path,) for path in (image.with_name(_stem(image) + suffix) for suffix in _SINGLE) if path.is_file()]
    pairs = (
        tuple(image.with_name(f"{_stem(image)}.{side}{suffix}") for side in ("moving", "fixed")) for suffix in _DOUBLE
    )
    candidates: list[tuple[Path, ...]] = [*found, *(pair for pair in pairs if all(path.is_file() for path in pair))]
    if len(candidates) > 1:
        names = " and ".join(files[0].name for files in candidates)
        raise ArgumentError(f"{image.parent}: {names} both belong to {image.name}", "leave one of them in the folder")
    return candidates[0] if candidates else ()


def jobs_in_table(table: Path, places: Places, fixed: Path | None) -> list[Job]:
    """The pairs of a table with the columns moving and landmarks, and optionally fixed, out and interpolation.

    An interpolation is that of one pair alone, such as nearest for labels; empty: that of all.
    Names are relative to the table's folder; two landmark files of one pair are separated by a semicolon. Raises
    ArgumentError, naming the line, for what is no such table.
    """
    jobs = []
    for line, row in _rows(table):
        moving, names = row.get("moving", ""), [name for name in row.get("landmarks", "").split(";") if name.strip()]
        if not moving or len(names) not in (1, 2):
            raise ArgumentError(f"{table}:{line}: an image and its landmarks are missing", "fill moving and landmarks")
        out = table.parent / row["out"] if row.get("out") else None
        if out is None and places.out is None:
            raise ArgumentError(f"{table}:{line}: there is no place for the result", "fill out, or give --out FOLDER")
        other = table.parent / row["fixed"] if row.get("fixed") else fixed
        files = tuple(table.parent / name.strip() for name in names)
        jobs.append(places.job(table.parent / moving, files, other, out, _interpolation(table, line, row)))
    if not jobs:
        raise ArgumentError(f"{table} holds no pairs", "give one row for every pair")
    return _distinct(jobs)


def _interpolation(table: Path, line: int, row: dict[str, str]) -> Interpolation | None:
    named = row.get("interpolation", "")
    if not named:
        return None
    choices: tuple[Interpolation, ...] = get_args(Interpolation)
    known = next((own for own in choices if own == named), None)
    if known is None:
        raise ArgumentError(f"{table}:{line}: unknown interpolation {named!r}", f"fill in one of {', '.join(choices)}")
    return known


def _rows(table: Path) -> Iterable[tuple[int, dict[str, str]]]:
    """Lines of the table by their columns, with line numbers."""
    try:
        with table.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            header = set(reader.fieldnames or ())
            if not {"moving", "landmarks"} <= header <= set(_TABLE):
                finding = f"{table}: the columns are {','.join(map(str, reader.fieldnames or ()))[:100] or 'missing'}"
                raise ArgumentError(finding, f"name them {','.join(_TABLE)} in the first line")
            for row in reader:
                if None in row or None in row.values():
                    finding = f"{table}:{reader.line_num}: not as many values as columns"
                    raise ArgumentError(finding, f"give {','.join(_TABLE)}, empty where there is none")
                if reader.line_num > MOST_PAIRS:
                    raise ArgumentError(f"{table} holds more than {MOST_PAIRS} lines", "give several tables")
                yield reader.line_num, {name: value.strip() for name, value in row.items()}
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ArgumentError(f"{table} cannot be read ({one_line(str(error), 100)})", "give a table as text") from error


def _distinct(jobs: list[Job]) -> list[Job]:
    """Refuse pairs whose outputs have the same name: the later would replace the earlier."""
    seen: dict[Path, Job] = {}
    for job in jobs:
        for path in job.written:
            other = seen.setdefault(path.absolute(), job)
            if other is not job:
                finding = f"{other.moving} and {job.moving} would both be written to {path}"
                raise ArgumentError(finding, "give images different names, or an out for each in a table")
    return jobs


def require_free(jobs: Iterable[Job], path: Path) -> None:
    """Refuse a pair whose page would take the name of the page about all pairs."""
    for job in jobs:
        if path.absolute() in (place.absolute() for place in job.written):
            finding = f"{path} is the page about all pairs, and that of {job.moving}"
            raise ArgumentError(finding, "rename the image, or give it another out in a table")


def make_folders(places: Places) -> None:
    """Make the folders of the outputs; FileError where the file system refuses."""
    for folder in (places.out, places.field, places.report):
        if folder is not None:
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise refused(error, folder) from error
