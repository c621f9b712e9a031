"""From uploaded files to a frame: sizes and formats are looked at in the headers, before anything is decoded."""

from __future__ import annotations

import io
import re
import warnings
from dataclasses import dataclass

import numpy as np
from PIL import Image

from thinkgrasp.cameras.calibration import Upload
from thinkgrasp.cameras.files import load_frame
from thinkgrasp.errors import InputError
from thinkgrasp.types import Frame

COLOR_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP")
EXACT_FORMATS = ("PNG", "TIFF")
"""For depth and masks, whose numbers must come through as they are."""
MIN_SIDE_PX = 8
MAX_ASPECT = 16
"""Of the longer side to the shorter one; narrower pictures come from no camera, and are costly to draw on."""

_QUOTED_PATH = re.compile(r"""(['"])(?:file://|[A-Za-z]:\\|~?/)[^'"\n]*\1""")
_PATH = re.compile(r"(?<![\w:/])(?:[A-Za-z]:\\|file:///|~?/)[\w.@+-]+(?:[/\\][\w.@+-]+)+/?")


class TooLarge(InputError):
    """An image has more pixels than the server takes."""


@dataclass(frozen=True)
class FrameUpload:
    """The files of one frame as they arrived."""

    color: bytes
    depth: bytes
    camera: bytes
    workspace: bytes | None = None
    depth_scale: float | None = None


def decode_frame(upload: FrameUpload, max_pixels: int) -> Frame:
    """Decode an uploaded frame.

    Raises:
        TooLarge: An image's header says that it has more than `max_pixels`.
        InputError: A file cannot be used; the message names it by its role.
    """
    color, depth = Upload("upload", upload.color), Upload("upload", upload.depth)
    _look_at(color, "colour", COLOR_FORMATS, max_pixels)
    _look_at(depth, "depth", EXACT_FORMATS, max_pixels)
    workspace = None
    if upload.workspace is not None:
        workspace = Upload("upload", upload.workspace)
        _look_at(workspace, "workspace mask", EXACT_FORMATS, max_pixels)
    try:
        return load_frame(
            color, depth, Upload("upload", upload.camera), depth_scale=upload.depth_scale, workspace_mask=workspace
        )
    except InputError as error:
        raise InputError(str(error).replace("--depth-scale", "depth_scale")) from error


def without_paths(text: str) -> str:
    """Return a message with file paths replaced, for messages that come from plug-ins and libraries."""
    return _PATH.sub("[path]", _QUOTED_PATH.sub("[path]", text))


def _look_at(upload: Upload, what: str, formats: tuple[str, ...], max_pixels: int) -> None:
    """Refuse by the header what is too large, too small, or of another format."""
    width, height = _array_size(upload, what) if upload.suffix == ".npy" else _image_size(upload, what, formats)
    if width * height > max_pixels:
        raise TooLarge(f"the {what} image is {width}x{height}; at most {max_pixels / 1e6:g} megapixels are allowed")
    if min(width, height) < MIN_SIDE_PX:
        raise InputError(f"the {what} image is {width}x{height}; at least {MIN_SIDE_PX}x{MIN_SIDE_PX} are needed")
    if max(width, height) > MAX_ASPECT * min(width, height):
        raise InputError(f"the {what} image is {width}x{height}; one side may be {MAX_ASPECT} times the other at most")


def _image_size(upload: Upload, what: str, formats: tuple[str, ...]) -> tuple[int, int]:
    allowed = f"{', '.join(formats)} and .npy"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            image = Image.open(io.BytesIO(upload.data), formats=formats)
        except Image.DecompressionBombError as error:
            raise TooLarge(f"the {what} image is far too large") from error
        except Image.UnidentifiedImageError as error:
            raise InputError(f"the {what} image is of no format that is read here; allowed are {allowed}") from error
        except Exception as error:  # decoders raise many types on broken data
            raise InputError(f"the {what} image cannot be decoded; allowed are {allowed}") from error
        return image.size


def _array_size(upload: Upload, what: str) -> tuple[int, int]:
    """Return the size (width, height) that a .npy header claims; it is held against the data when that is read."""
    file = io.BytesIO(upload.data)
    try:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, _ = read(file)
    except Exception as error:  # the header parser raises many types on broken data
        raise InputError(f"the {what} array is not a readable .npy file") from error
    if len(shape) not in (2, 3) or (len(shape) == 3 and shape[2] not in (1, 3, 4)):
        raise InputError(f"the {what} array has shape {shape}; (H, W) or (H, W, channels) is needed")
    return shape[1], shape[0]
