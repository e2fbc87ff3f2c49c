"""Small pictures of noise, and a session of the page with two of them."""

import io

import numpy as np
from PIL import Image

from codegen.registration.app.session import Picture, Session
from codegen.registration.images import write_image

SHAPE = (40, 60)
_RNG = np.random.default_rng(5)


def picture(shape=SHAPE, dtype=np.uint8, name="a.png"):
    pixels = (_RNG.random((*shape, 3)) * (255 if dtype == np.uint8 else 65535)).astype(dtype)
    out = io.BytesIO()
    if dtype == np.uint8:
        Image.fromarray(pixels).save(out, "PNG")
    return Picture(pixels, name, out.getvalue())


def two_pictures():
    """A session whose fixed picture is larger than the moving one, of SHAPE."""
    return Session(picture(), picture((50, 70), name="b.png"))


def with_pictures(folder):
    """The folder with two pictures of noise, `moving.png` and `fixed.png`, of SHAPE."""
    for k, name in enumerate(("moving", "fixed")):
        write_image(folder / f"{name}.png", np.random.default_rng(k).integers(0, 255, SHAPE).astype(np.uint8))
    return folder
