"""Files that a browser sends: names, sizes, landmarks in two files, the spacing of pixels, and the example."""

import io

import numpy as np
import pytest
import tifffile
from small_pictures import SHAPE, picture

from codegen.errors import ImageError, PointsError
from codegen.registration.app import reading
from codegen.registration.formats import FORMATS, landmark_texts
from codegen.registration.formats.base import Frames
from codegen.registration.pairs import LandmarkPairs

PAIR = LandmarkPairs([[1.0, 2.0], [8.0, 9.0]], [[2.0, 4.0], [9.0, 7.0]])
TWO_FILES = [form for form in FORMATS.values() if form.files == 2]


def test_names_of_files_never_become_paths():
    data = picture().source
    for name in ("../../etc/passwd.png", "C:\\x\\y.png", "/abs/z.png", "<b>&.png", "." * 300, ""):
        made = reading.picture_from(data, name)
        assert "/" not in made.name
        assert "\\" not in made.name
        assert made.stem
        assert all(c.isalnum() or c in "-_" for c in made.stem)


def test_what_is_too_large_is_refused_before_it_is_decoded(monkeypatch):
    header = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR" + (100_000).to_bytes(4, "big") * 2 + b"\x08\x02\x00\x00\x00"
    with pytest.raises(ImageError):
        reading.picture_from(header + b"\x00" * 100, "bomb.png")
    with pytest.raises(ImageError, match="bytes"):
        reading.picture_from(b"\x89PNG" + bytes(reading.LIMITS.bytes), "large.png")


@pytest.mark.parametrize("form", TWO_FILES, ids=lambda form: form.name)
@pytest.mark.parametrize(
    ("moving", "fixed", "turned", "why"),
    [("a", "b", False, "order"), ("moving", "fixed", False, "names"), ("moving", "fixed", True, "names"),
     ("a", "b_target", False, "names"), ("a", "b_target", True, "names"), ("x_source", "a", True, "names")],
)  # fmt: skip
def test_two_landmark_files_are_told_apart_by_name_or_else_by_order(form, moving, fixed, turned, why):
    texts = landmark_texts(PAIR, form.name)
    files = [(name + form.suffixes[0], text.encode()) for name, text in zip((moving, fixed), texts)]
    ordered, (remark,) = reading.in_order(files[::-1] if turned else files)
    found = reading.parse_landmarks(ordered)
    np.testing.assert_array_equal((found.moving, found.fixed), (PAIR.moving, PAIR.fixed))
    assert remark.startswith(f"{moving}{form.suffixes[0]} was taken for the moving image")
    assert why in remark


@pytest.mark.parametrize("form", FORMATS.values(), ids=lambda form: form.name)
def test_a_landmark_file_without_its_partner_is_refused_with_the_remedy(form):
    frames = Frames(SHAPE, SHAPE)
    single = [("points" + form.suffixes[0], landmark_texts(PAIR, form.name, frames)[0].encode())]
    if form.files == 2:
        with pytest.raises(PointsError, match=r"one image only; choose the moving and the fixed file together"):
            reading.in_order(single)
    else:
        assert reading.in_order(single) == (single, [])


def test_the_spacing_of_tiff_files_is_read_where_it_means_something():
    pixels = np.zeros((4, 5), np.uint16)

    def spacing(**values):
        out = io.BytesIO()
        tifffile.imwrite(out, pixels, **values)
        return reading.picture_from(out.getvalue(), "a.tif").spacing

    found = spacing(imagej=True, resolution=(2.0, 4.0), metadata={"unit": "um"})
    assert (found.x, found.y, found.unit) == (0.5, 0.25, "µm")
    sizes = {"axes": "YX", "PhysicalSizeX": 0.5, "PhysicalSizeXUnit": "nm", "PhysicalSizeY": 0.25}
    found = spacing(ome=True, metadata=sizes)
    assert (found.x, found.y, found.unit) == (0.5, 0.25, "nm")
    found = spacing(ome=True, metadata=sizes | {"PhysicalSizeYUnit": "pm", "PhysicalSizeY": 250.0})
    assert (found.x, found.y, found.unit) == (0.5, pytest.approx(0.25), "nm")
    mixed = {"PhysicalSizeX": 25.4, "PhysicalSizeXUnit": "mm", "PhysicalSizeYUnit": "inch"}
    found = spacing(ome=True, metadata=sizes | mixed)
    assert (found.x, found.y, found.unit) == (25.4, pytest.approx(6.35), "mm")
    with pytest.raises(ImageError, match="in nm and reference frame, which cannot be converted; save it with one unit"):
        spacing(ome=True, metadata=sizes | {"PhysicalSizeYUnit": "reference frame"})
    found = spacing(resolution=(100.0, 50.0), resolutionunit=3)
    assert (found.x, found.y, found.unit) == (0.1, 0.2, "mm")
    assert spacing() is None
    assert spacing(resolution=(72.0, 72.0), resolutionunit=2) is None  # what programs write that know nothing
    assert picture().spacing is None


def test_the_example_is_complete():
    made = reading.example()
    assert len(made.work.pairs) >= 15
    assert all(made.picture(side).contains(pair.at(side)) for pair in made.work.pairs for side in ("moving", "fixed"))
