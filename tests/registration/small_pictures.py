"""Small pictures of noise, and a session of the page with two of them."""

import io

import numpy as np
from PIL import Image

from codegen.registration.app.picture import Picture
from codegen.registration.app.session import Session

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
