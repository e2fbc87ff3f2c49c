"""Image files: samples kept as they were, orientations, limits before decoding, and what is refused."""

import io
import itertools
import struct
import tracemalloc
import zlib

import numpy as np
import pytest
import tifffile
from PIL import Image as Pillow
from PIL import ImageOps

from codegen.errors import ImageError
from codegen.registration.images import Limits, read_image, write_image

SHAPES = ((5, 7), (5, 7, 2), (5, 7, 3), (5, 7, 4))
KEPT = {".png": ("u1", "u2"), ".tif": ("u1", "u2", "i2", "u4", "i4", "f4", "f8")}


def pixels_of(kind, shape):
    return (np.random.default_rng(1).random(shape) * (1.0 if kind[0] == "f" else 250.0)).astype(kind)


def encoded(pixels, kind, **options):
    file = io.BytesIO()
    Pillow.fromarray(pixels).save(file, format=kind, **options)
    return file.getvalue()


CASES = [(suffix, kind, shape) for suffix in KEPT for kind, shape in itertools.product(KEPT[suffix], SHAPES)]
CASES.remove((".png", "u2", SHAPES[1]))  # refused by name, as asserted below


@pytest.mark.parametrize(("suffix", "kind", "shape"), CASES)
def test_samples_and_channels_are_kept(suffix, kind, shape, tmp_path):
    pixels = pixels_of(kind, shape)
    pixels.flat[0] = np.iinfo(kind).max if kind[0] != "f" else np.pi
    path = tmp_path / f"image{suffix}"
    write_image(path, pixels)
    again = read_image(path)
    assert again.pixels.dtype == pixels.dtype
    np.testing.assert_array_equal(again.pixels, pixels)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_jpeg_is_near_and_names_do_not_decide(tmp_path):
    y, x = np.mgrid[:64, :48]
    pixels = np.stack([2 * x, 2 * y, x + y], axis=-1).astype(np.uint8)
    path = tmp_path / "image.jpg"
    write_image(path, pixels)
    path = path.rename(tmp_path / "image.png")
    image = read_image(path)
    assert image.kind == "JPEG"
    assert np.abs(image.pixels.astype(int) - pixels).max() <= 6


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "TIFF"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientations_are_applied_as_pillow_applies_them(kind, orientation):
    pixels = np.zeros((16, 24), np.uint8)
    pixels[:8, :8], pixels[8:, :8] = 255, 128
    if kind == "TIFF":
        file = io.BytesIO()
        tifffile.imwrite(file, pixels, extratags=[(274, "H", 1, orientation, True)])
        data = file.getvalue()
    else:
        exif = Pillow.Exif()
        exif[0x0112] = orientation
        data = encoded(pixels, kind, exif=exif)
    with Pillow.open(io.BytesIO(data)) as picture:
        expected = np.asarray(ImageOps.exif_transpose(picture))
    np.testing.assert_array_equal(read_image(data).pixels, expected)
    assert read_image(data).pixels.shape == ((16, 24) if orientation < 5 else (24, 16))


@pytest.mark.parametrize("compression", [None, "tiff_lzw", "tiff_adobe_deflate", "packbits"])
def test_compressed_tiff_files_are_read(compression):
    pixels = pixels_of("u1", (40, 30, 3))
    np.testing.assert_array_equal(read_image(encoded(pixels, "TIFF", compression=compression)).pixels, pixels)


def test_planes_tiles_and_the_other_byte_order_are_read():
    pixels = pixels_of("u2", (40, 50, 3))
    for options in ({"byteorder": ">"}, {"tile": (16, 16), "compression": "zlib"}, {"bigtiff": True}):
        file = io.BytesIO()
        tifffile.imwrite(file, pixels, photometric="rgb", **options)
        np.testing.assert_array_equal(read_image(file.getvalue()).pixels, pixels)
    file = io.BytesIO()
    tifffile.imwrite(file, np.moveaxis(pixels, -1, 0), photometric="rgb", planarconfig="separate")
    np.testing.assert_array_equal(read_image(file.getvalue()).pixels, pixels)


def test_palettes_single_bits_and_transparent_colours_become_channels():
    palette = Pillow.fromarray(pixels_of("u1", (6, 5, 3))).quantize(8)
    file = io.BytesIO()
    palette.save(file, "PNG")
    np.testing.assert_array_equal(read_image(file.getvalue()).pixels, np.asarray(palette.convert("RGB")))
    bits = np.arange(30).reshape(5, 6) % 3 == 0
    for kind in ("PNG", "TIFF"):
        np.testing.assert_array_equal(read_image(encoded(bits, kind)).pixels, np.where(bits, 255, 0))
    grey = np.array([[0, 7], [7, 255]], np.uint8)
    with_opacity = read_image(encoded(grey, "PNG", transparency=7)).pixels
    np.testing.assert_array_equal(with_opacity[..., 1], [[255, 0], [0, 255]])


def test_colour_profiles_are_kept(tmp_path):
    for suffix in (".png", ".jpg", ".tif"):
        write_image(tmp_path / f"a{suffix}", pixels_of("u1", (4, 4, 3)), profile=b"profile" * 20)
        assert read_image(tmp_path / f"a{suffix}").profile == b"profile" * 20


def png(width, height, bits=8, colour=0, body=b""):
    """A PNG file with any size in its header."""
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)), (b"IDAT", body), (b"IEND", b"")]
    framed = [struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(framed)


def tiff(width, height, count=1, body=b"\0" * 16, compression=1):
    """A grey TIFF file of one strip with any size in its header."""
    tags = [(256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 8), (259, 3, 1, compression), (262, 3, 1, 1),
            (273, 4, count, 8), (277, 3, 1, 1), (278, 4, 1, height), (279, 4, 1, len(body))]  # fmt: skip
    place = 8 + len(body)
    listed = b"".join(struct.pack("<HHII", *tag) for tag in tags)
    return b"II*\0" + struct.pack("<I", place) + body + struct.pack("<H", len(tags)) + listed + bytes(4)


def bomb(size=300_000_000):
    """So many zeros, compressed to a thousandth, without ever holding them."""
    packer = zlib.compressobj(9)
    return b"".join(packer.compress(bytes(1_000_000)) for _ in range(size // 1_000_000)) + packer.flush()


BOMB = bomb()

HUGE = {
    "PNG of 4 000 000 000 pixels": (png(100_000, 40_000, body=BOMB), "has 100000 x 40000 pixels, more than"),
    "PNG of no pixels": (png(0, 5), "has 0 x 5 pixels"),
    "PNG with too much data": (png(10, 10, body=BOMB), None),
    "PNG in colour with too much data": (png(10, 10, colour=2, body=BOMB), None),
    "TIFF of 4 000 000 000 pixels": (tiff(100_000, 40_000), "has 100000 x 40000 pixels, more than"),
    "TIFF whose strip unfolds": (tiff(10, 10, body=BOMB, compression=8), "unfolds to more than its pixels"),
    "TIFF with 4 000 000 000 strips": (tiff(10, 10, count=2**32 - 1), None),
    "TIFF cut off": (tiff(2000, 2000), None),
    "JPEG of 65 535 x 65 535 pixels": (
        b"\xff\xd8\xff\xe0\0\x10JFIF\0\1\1\0\0\1\0\1\0\0\xff\xc0\0\x0b\x08\xff\xff\xff\xff\1\1\x11\0" + bytes(99),
        "has 65535 x 65535 pixels, more than",
    ),
}


@pytest.mark.parametrize("case", HUGE)
def test_memory_is_bounded_whatever_a_header_announces(case):
    data, finding = HUGE[case]
    read_image(encoded(pixels_of("u1", (4, 4)), "PNG")), read_image(encoded(pixels_of("u1", (4, 4)), "TIFF"))
    tracemalloc.start()
    message, shape = "", None
    try:
        shape = read_image(data, Limits(pixels=10_000_000), name="big").pixels.shape[:2]
    except ImageError as error:
        message = str(error)
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 60_000_000
    if finding is None and shape is not None:
        assert shape == (10, 10)
    else:
        assert message.startswith("big ")
        assert (finding or "") in message


def test_bytes_and_pixels_are_limited_before_decoding(tmp_path):
    path = tmp_path / "a.png"
    write_image(path, pixels_of("u1", (100, 100)))
    with pytest.raises(ImageError, match="has 100 x 100 pixels, more than 9999"):
        read_image(path, Limits(pixels=9_999))
    with pytest.raises(ImageError, match="more than 5000 bytes"):
        read_image(path, Limits(bytes=5_000))
    with pytest.raises(ImageError, match="more than 5000 bytes"):
        read_image(path.read_bytes(), Limits(bytes=5_000))


def saved(pixels, **options):
    file = io.BytesIO()
    tifffile.imwrite(file, pixels, **options)
    return file.getvalue()


def test_what_is_no_image_of_this_package_is_named(tmp_path):
    grey = np.zeros((8, 8), np.uint8)
    cmyk = io.BytesIO()
    Pillow.new("CMYK", (8, 8)).save(cmyk, "JPEG")
    for data, finding in (
        (b"", "is empty"),
        (encoded(grey, "GIF"), "is no PNG, JPEG or TIFF file"),
        (encoded(grey, "BMP"), "is no PNG, JPEG or TIFF file"),
        (b"<svg xmlns='http://www.w3.org/2000/svg'/>", "is no PNG, JPEG or TIFF file"),
        (cmyk.getvalue(), r"printing inks \(CMYK\)"),
        (saved(np.zeros((3, 8, 8), np.uint8), photometric="minisblack"), "holds several images"),
        (saved(grey, photometric="miniswhite"), "stores colours as MINISWHITE"),
        (saved(grey.astype(complex)), "holds samples of complex"),
        (saved(np.zeros((8, 8, 6), np.uint8), photometric="rgb"), "6 samples in a pixel"),
        (png(4, 4, bits=16, colour=4, body=zlib.compress(bytes(17 * 4))), "16-bit grey with opacity"),
    ):
        with pytest.raises(ImageError, match=finding):
            read_image(data)
    with pytest.raises(ImageError, match="cannot be read"):
        read_image(tmp_path / "none.png")


@pytest.mark.parametrize(
    ("name", "kind", "shape", "finding"),
    [
        ("a.jpg", "u2", (4, 4), "JPEG holds 8-bit"),
        ("a.jpg", "u1", (4, 4, 4), "JPEG holds 8-bit"),
        ("a.png", "f4", (4, 4), "PNG holds 8-bit or 16-bit"),
        ("a.png", "u2", (4, 4, 2), "16-bit grey with opacity"),
        ("a.tif", "c16", (4, 4), "samples of complex128"),
        ("a.gif", "u1", (4, 4), "unknown kind of image"),
        ("a.png", "u1", (4, 4, 5), "is no image"),
        ("a.png", "u1", (4,), "is no image"),
    ],
)
def test_what_a_file_cannot_hold_leaves_the_old_file(name, kind, shape, finding, tmp_path):
    path = tmp_path / name
    path.write_bytes(b"old")
    with pytest.raises(ImageError, match=finding):
        write_image(path, np.zeros(shape, kind))
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == [name]
