"""What the first bytes of an image file say, read before anything is decoded."""

from __future__ import annotations

import struct
import zlib

from codegen.errors import ImageError
from codegen.registration.images import codecs
from codegen.registration.images.codecs import Header

VOLUMES = (".nii", ".nii.gz", ".mha", ".mhd", ".nrrd", ".nhdr")
"""What `codegen.registration.volumes` reads."""
_PNG = b"\x89PNG\r\n\x1a\n"
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}

# Frames of JPEG (ITU-T T.81, table B.1): SOF0 to SOF15 without DHT, JPG and DAC; markers without a length.
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_BARE = frozenset(range(0xD0, 0xD9)) | {0x01, 0xFF}


def header_of(name: str, data: bytes) -> Header:
    """Read the header; ImageError when the bytes begin like no PNG, JPEG or TIFF file."""
    if data.startswith(_PNG):
        # The IHDR chunk, which comes first (PNG specification, 11.2.2).
        if len(data) < 33 or data[12:16] != b"IHDR" or zlib.crc32(data[12:29]) != struct.unpack(">I", data[29:33])[0]:
            raise ImageError(f"{name} has a damaged header", "give a whole PNG file")
        width, height, bits, colour = struct.unpack(">IIBB", data[16:26])
        return Header("PNG", width, height, bits, _PNG_CHANNELS.get(colour, 0))
    if data.startswith(b"\xff\xd8\xff"):
        return _jpeg(name, data)
    if data.startswith(_TIFF):
        return codecs.tiff_header(name, data)
    if name.lower().endswith(VOLUMES):
        raise ImageError(f"{name} is a volume, and this is for pictures", "give codegen warp two volumes")
    what = "is empty" if not data else "is no PNG, JPEG or TIFF file"
    raise ImageError(f"{name} {what}", "convert it to PNG, JPEG or TIFF")


def _jpeg(name: str, data: bytes) -> Header:
    """The frame header (ITU-T T.81, B.2.2), which follows any number of other segments."""
    place = 2
    while place + 4 <= len(data):
        marker = data[place + 1]
        if data[place] != 0xFF:
            break
        if marker in _BARE:
            place += 1 if marker == 0xFF else 2
            continue
        (length,) = struct.unpack(">H", data[place + 2 : place + 4])
        if marker in _FRAMES and place + 10 <= len(data):
            bits, height, width, samples = struct.unpack(">BHHB", data[place + 4 : place + 10])
            return Header("JPEG", width, height, bits, samples)
        if length < 2 or marker == 0xDA:
            break
        place += 2 + length
    raise ImageError(f"{name} has no frame header", "give a whole JPEG file")
