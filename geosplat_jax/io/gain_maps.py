"""Photographs with a gain map (Ultra HDR), as telephones write them: the ordinary JPEG inside.

Such a file is a JPEG in sRGB, followed by a map of factors for screens that are brighter than
white. OpenImageIO multiplies the picture by the map and returns linear light; photographs without a
map in the same capture would then have other colours, and bright parts would be cut off at white.
So the ordinary JPEG is read by itself, as most other programs do.
"""

import io
from pathlib import Path

from PIL import ExifTags, ImageCms
from PIL.JpegImagePlugin import JpegImageFile

_MARK = b"hdrgm:Version"
"""Attribute by which OpenImageIO recognises a gain map; it stands in the metadata."""

_HEADER_BYTES = 1 << 18
"""Bytes of a file that are searched for it: metadata come before the pixels."""


def base_picture(path: Path) -> JpegImageFile | None:
    """Open the ordinary JPEG of a file with a gain map; its pixels are not decoded yet.

    Returns
    -------
    The picture, to be closed by the caller; None for every other file.

    Raises
    ------
    OSError, SyntaxError : the file cannot be read, or is no JPEG.
    """
    if path.suffix.lower() not in (".jpg", ".jpeg"):
        return None
    with path.open("rb") as file:
        if _MARK not in file.read(_HEADER_BYTES):
            return None
    return JpegImageFile(path)


def orientation(picture: JpegImageFile) -> int:
    """Return the EXIF orientation, 1 to 8."""
    return int(picture.getexif().get(ExifTags.Base.Orientation, 1))


def profile_name(picture: JpegImageFile) -> str:
    """Return the name of the embedded colour profile; empty without a readable one."""
    content = picture.info.get("icc_profile")
    if not content:
        return ""
    try:
        return ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(content)))
    except (ImageCms.PyCMSError, OSError):
        return ""
