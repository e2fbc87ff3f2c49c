"""The sources of the site: links hold, names and words have their places, records of the gallery fit what is known."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from conftest import PROBLEMS
from PIL import Image
from references import LOWER, STORED, UNSOLVED, digest, known_of, misses, problem_files

import codegen
from codegen import errors
from codegen.batch.case import MEANINGS
from codegen.cli.options import PAGE
from codegen.solving.results.result import STATUSES

ROOT = PROBLEMS.parent
DOCS = ROOT / "docs"
OBJECTS = DOCS / "reference" / "objects"
MADE = {DOCS / "reference" / "commands.md", DOCS / "gallery" / "index.md", DOCS / "benchmarks.md", DOCS / "thesis.md"}
MADE |= {DOCS / "gallery" / f"{path.stem}.md" for path in problem_files()}
MADE |= {OBJECTS / f"{name}{'-class' * name[0].isupper()}.md" for name in ("index", "Result", *codegen.__all__)}
"""Pages that are made when the site is built."""
PAGES = sorted(path for path in DOCS.rglob("*.md") if "_build" not in path.parts and path not in MADE)
LINK = re.compile(r"\]\(([^)\s]+)\)")
RECORDS = sorted(STORED.glob("*.json"))


def text_of(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def prose_of(path: Path) -> str:
    """A page without its blocks of code."""
    without_fences = re.sub(r"^```.*?^```$", "", text_of(path), flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"^    .*$", "", without_fences, flags=re.MULTILINE)


def anchors_of(path: Path) -> set[str]:
    headings = re.findall(r"^#+ (.*)$", prose_of(path), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", [ROOT / "README.md", *PAGES], ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for link in LINK.findall(prose_of(page)):
        if "://" in link:
            continue
        file, _, anchor = link.partition("#")
        target = (page.parent / file).resolve() if file else page
        assert target in MADE or target.exists(), link
        if anchor and target not in MADE:
            assert anchor in anchors_of(target), link


def test_the_readme_is_one_screen_and_a_half():
    assert len(text_of(ROOT / "README.md").splitlines()) <= 200


def test_every_page_is_in_a_table_of_contents():
    listed = set()
    for page in [*PAGES, DOCS / "gallery" / "index.in"]:
        for block in re.findall(r"^```\{toctree\}\n(.*?)^```$", text_of(page), re.MULTILINE | re.DOTALL):
            names = [line for line in block.splitlines() if line and not line.startswith(":")]
            listed |= {(page.parent / f"{name}.md").resolve() for name in names}
    own = {DOCS / "index.md", DOCS / "README.md"}
    assert set(PAGES) - listed - own == set()
    assert {path for path in listed if not path.exists()} <= MADE


def test_every_public_name_has_its_signature_and_an_example():
    page = text_of(DOCS / "reference" / "python.md")
    for name in codegen.__all__:
        section = page.split(f"\n### {name}\n", 1)[1].split("\n### ")[0].split("\n## ")[0]
        assert f"```{{signature}} {name}\n```" in section, name
        example = section.split("```{code-cell} ipython3\n", 1)[1]
        assert re.search(rf"\b{name}\b|solver\.", example), name


def test_every_status_and_every_kind_of_error_has_an_anchor():
    page = text_of(DOCS / "guide" / "statuses.md")
    assert page.startswith(f"# {PAGE}\n")  # to which failed commands refer
    headings = set(re.findall(r"^### (.*)$", page, re.MULTILINE))
    kinds = {
        name
        for name, kind in vars(errors).items()
        if isinstance(kind, type) and issubclass(kind, errors.CodegenError) and kind is not errors.CodegenError
    }
    assert set(STATUSES) | kinds <= headings
    of_sweeps = set(MEANINGS) - set(STATUSES)
    assert of_sweeps == set(re.findall(r"^(.*)\n: ", page, re.MULTILINE))


def test_the_page_on_benchmarks_says_when_and_on_what_everything_was_measured():
    records = [json.loads(text_of(path)) for path in sorted((DOCS / "measured").glob("*.json"))]
    assert {"pendulum", "orbital_transfer"} <= {record.get("problem") for record in records}
    for record in records:
        assert re.fullmatch(r"\d{4}-\d\d-\d\d", record["date"])
        assert record["machine"]["processor"]
    cases = json.loads(text_of(DOCS / "measured" / "robustness.json"))["cases"]
    assert all(set(case["solvers"]) == {"generated", "IPOPT"} for case in cases)


def test_every_problem_is_in_the_gallery():
    everything = {path for path in PROBLEMS.rglob("*.py") if "__pycache__" not in path.parts}
    assert set(problem_files()) == everything
    assert len({path.stem for path in everything}) == len(everything)
    assert {path.stem for path in RECORDS} <= {path.stem for path in everything}


@pytest.mark.parametrize("record", RECORDS, ids=lambda path: path.stem)
def test_a_record_belongs_to_its_problem_and_to_what_is_known_of_it(record):
    read = json.loads(text_of(record))
    (path,) = (path for path in problem_files() if path.stem == record.stem)
    assert read["digest"] == digest(path), "the problem has changed; run: python docs/record.py"
    assert read["solution"]["status"] == UNSOLVED.get(record.stem, "solved")
    assert (STORED / f"{record.stem}.png").exists()
    cases = {case["of"]: case for case in read["cases"]}
    for known in known_of(record.stem):
        assert misses(known, cases[known.title]) == ""


def test_every_drawing_has_a_film_and_a_still_picture_on_record():
    with_drawing = [path for path in problem_files() if "drawing=" in text_of(path)]
    assert with_drawing
    for path in with_drawing:
        film = json.loads(text_of(STORED / f"{path.stem}.json"))["film"]
        assert film["shows"]
        with Image.open(STORED / f"{path.stem}.gif") as moving, Image.open(STORED / f"{path.stem}.still.png") as still:
            assert moving.n_frames > 20
            assert list(moving.size) == list(still.size) == film["size"]
            assert (STORED / f"{path.stem}.gif").stat().st_size < 300_000


SPEED = json.loads(text_of(DOCS / "gallery" / "speed.json"))


@pytest.mark.parametrize("case", SPEED.values(), ids=SPEED)
def test_times_beside_casadi_are_of_the_same_optimum_or_say_that_they_are_not(case):
    assert case["problem"] in {path.stem for path in problem_files()}
    own, *others = case["solvers"].values()
    same = [abs(own["cost"] - other["cost"]) <= 1e-5 * max(1e-3, abs(other["cost"])) for other in others]
    solved = {each["status"] for each in (own, *others)} == {"solved"}
    assert case["comparable"] == (solved and all(same))
    if own["status"] == "solved" and not case["comparable"]:
        assert case["problem"] in LOWER
    assert case["machine"]["processor"]
    assert case["date"]


def test_a_value_that_misses_is_found():
    known = known_of("cart_pole")[0]
    case = {"status": "solved", "cost": known.optimum}
    assert misses(known, case) == ""
    assert "known is" in misses(known, case | {"cost": known.optimum + 2 * known.allowed})
    assert "IPOPT" in misses(known, case | {"cost": known.optimum * (1 + 2e-8)})
    assert "is stalled" in misses(known, case | {"status": "stalled"})
