"""RGB-D frames from files: decode what cameras and tools write, refuse what cannot be right, and say why."""

from __future__ import annotations

import io
import math
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from thinkgrasp.cameras.calibration import Calibration, Upload, check_depth_scale, read_calibration, require_file
from thinkgrasp.errors import InputError
from thinkgrasp.types import Array, CameraIntrinsics, Frame, Mask

DEFAULT_DEPTH_SCALE = 0.001
"""Metres per unit of an integer depth image when nothing else says so: millimetres."""
MAX_PIXELS = 64_000_000
"""Larger images are refused before they are decoded."""
NEAR_LIMIT_M = 0.05
REACH_LIMIT_M = 4.0
"""A frame whose nearest twentieth lies beyond this holds nothing that an arm could take."""
FAR_LIMIT_M = 20.0
"""A frame whose median lies beyond this is not a table but a wrong unit."""

NO_RETURN_M = 1000.0
"""Single pixels beyond this are no distances but what some devices write for no return."""

FilePath = str | Path
Source = FilePath | Upload
"""A file, or what one would hold."""


def load_frame(
    color: Source,
    depth: Source,
    camera: Source,
    *,
    depth_scale: float | None = None,
    workspace_mask: Source | None = None,
) -> Frame:
    """Read one aligned RGB-D view.

    Args:
        color: Any image Pillow reads, or .npy; 8 or 16 bit, grey, palette, RGB or RGBA (alpha is dropped).
        depth: 16-bit PNG or TIFF, float TIFF, or .npy, (H, W). Integers are units of the depth scale; floats metres.
        camera: Camera file; see `thinkgrasp.cameras.calibration.read_calibration`.
        depth_scale: Metres per unit; overrides the camera file's (default 0.001). Given, it scales floats too.
        workspace_mask: Image of the same size; non-zero = grasping is allowed.

    Returns:
        The frame; pixels without return (0, NaN, infinite, saturated 65535) have depth 0.

    Raises:
        InputError: A file cannot be used, sizes differ, or the depth cannot be in the unit it is said to be in.
    """
    if depth_scale is not None:
        check_depth_scale(depth_scale, "--depth-scale")
    calibration = read_calibration(camera)
    image = read_color(color)
    size_wh = (image.shape[1], image.shape[0])
    raw = _read_depth_array(_located(depth))
    if (raw.shape[1], raw.shape[0]) != size_wh:
        raise InputError(
            f"colour {color} is {size_wh[0]}x{size_wh[1]} but depth {depth} is {raw.shape[1]}x{raw.shape[0]}; "
            "align depth to colour first"
        )
    intrinsics = _intrinsics(calibration, size_wh, camera)
    if (intrinsics.width, intrinsics.height) != size_wh:
        raise InputError(
            f"camera file {camera} is for {intrinsics.width}x{intrinsics.height} images but {color} is "
            f"{size_wh[0]}x{size_wh[1]}; give the intrinsics of this resolution"
        )
    metres = _to_metres(raw, depth, depth_scale, calibration.depth_scale)
    workspace = None if workspace_mask is None else _read_workspace(_located(workspace_mask), metres)
    return Frame(image, metres, intrinsics, calibration.T_world_camera, workspace)


def load_camera(path: FilePath) -> tuple[CameraIntrinsics, float | None, NDArray[np.float64] | None]:
    """Return intrinsics, depth scale [m per unit] and T_world_camera (4, 4) of a camera file; None = not given.

    Raises:
        InputError: The file cannot be used, or does not name the image size.
    """
    calibration = read_calibration(path)
    if calibration.size_wh is None:
        raise InputError(f"camera file {path} lacks width and height")
    return (
        _intrinsics(calibration, calibration.size_wh, path),
        calibration.depth_scale,
        calibration.T_world_camera,
    )


class FileCamera:
    """A camera that reads the same files at every `read`; arguments as in `load_frame`."""

    def __init__(
        self,
        *,
        color: FilePath,
        depth: FilePath,
        camera: FilePath,
        depth_scale: float | None = None,
        workspace_mask: FilePath | None = None,
    ) -> None:
        self.color = color
        self.depth = depth
        self.camera = camera
        self.depth_scale = depth_scale
        self.workspace_mask = workspace_mask

    def read(self) -> Frame:
        """Read the files as they are now.

        Raises:
            InputError: As `load_frame`.
        """
        return load_frame(
            self.color,
            self.depth,
            self.camera,
            depth_scale=self.depth_scale,
            workspace_mask=self.workspace_mask,
        )


def read_color(path: Source) -> NDArray[np.uint8]:
    """Read a colour image as (H, W, 3) uint8 RGB.

    Sixteen bits keep their upper eight; alpha is dropped; grey is repeated; the EXIF orientation is applied.

    Raises:
        InputError: The file cannot be decoded, or its pixels are not 8- or 16-bit.
    """
    path = _located(path)
    if path.suffix.lower() == ".npy":
        return _color_from_array(_load_npy(path, "colour"), path)
    image = _open(path, "colour")
    if image.mode.startswith("I") or image.mode == "F":
        return _color_from_array(_pixels(image, path, "colour"), path)
    try:
        return np.array(ImageOps.exif_transpose(image).convert("RGB"))
    except Exception as error:  # decoders raise many types on broken data
        raise _undecodable(path, "colour", error) from error


def _color_from_array(pixels: NDArray[np.generic], path: Path | Upload) -> NDArray[np.uint8]:
    if pixels.dtype.kind not in "ui" or pixels.dtype.itemsize > 4:
        raise InputError(f"colour image {path} has {pixels.dtype} pixels; 8- or 16-bit whole numbers are allowed")
    grey = pixels.ndim == 2
    if not (grey or (pixels.ndim == 3 and pixels.shape[2] in (1, 3, 4))) or pixels.size == 0:
        raise InputError(f"colour image {path} has shape {pixels.shape}; allowed are (H, W), (H, W, 3) and (H, W, 4)")
    values = pixels.astype(np.int64)
    if values.min() < 0 or values.max() > 65535:
        raise InputError(f"colour image {path} has values in {values.min()}..{values.max()}; allowed are 0..65535")
    if pixels.dtype.itemsize > 1:
        values >>= 8
    return np.broadcast_to(np.atleast_3d(values)[..., :3], (*values.shape[:2], 3)).astype(np.uint8)


def _read_depth_array(path: Path | Upload) -> NDArray[np.generic]:
    """Return the stored numbers (H, W) of a depth file, unscaled."""
    if path.suffix.lower() == ".npy":
        array = _load_npy(path, "depth")
        if array.ndim == 3 and array.shape[2] == 1:
            array = array[..., 0]
    else:
        image = _open(path, "depth")
        if len(image.getbands()) != 1:
            raise InputError(
                f"depth image {path} has {len(image.getbands())} channels ({image.mode}): it looks like a picture of "
                "the depth; one channel of 16-bit or float values is needed"
            )
        array = _pixels(image, path, "depth")
    if array.ndim != 2 or array.size == 0:
        raise InputError(f"depth {path} has shape {array.shape}; (H, W) is needed")
    if array.dtype.kind not in "uif" or array.dtype.itemsize == 1:
        bits = f"{8 * array.dtype.itemsize}-bit {array.dtype}"
        raise InputError(f"depth {path} has {bits} pixels, too coarse for distances; save it as 16-bit or float")
    return array


def _to_metres(raw: NDArray[np.generic], path: Source, given: float | None, camera_scale: float | None) -> Array:
    is_float = raw.dtype.kind == "f"
    scale = given if given is not None else 1.0 if is_float else camera_scale or DEFAULT_DEPTH_SCALE
    values = raw.astype(np.float64)
    missing = ~np.isfinite(values)
    if raw.dtype.newbyteorder("=") == np.uint16:
        missing |= raw == np.uint16(65535)
    values[missing] = 0
    if (values < 0).any():
        share = float((values < 0).mean())
        raise InputError(
            f"depth {path} is negative in {share:.1%} of the pixels (lowest {values.min():g}); it must grow away from "
            "the camera, with 0 or NaN for no return"
        )
    valid = values[values > 0]
    if not valid.size:
        raise InputError(f"depth {path} holds no return at all: every pixel is 0, NaN, infinite or saturated")
    _check_unit(np.percentile(valid, [5, 50]), scale, path, is_float=is_float)
    metres = values * scale
    return np.where(metres > NO_RETURN_M, 0, metres).astype(np.float32)


def _check_unit(quantiles: NDArray[np.float64], scale: float, path: Source, *, is_float: bool) -> None:
    near, median = (float(q) for q in quantiles * scale)
    if median >= NEAR_LIMIT_M and near <= REACH_LIMIT_M and median <= FAR_LIMIT_M:
        return
    raw_median = float(quantiles[1])
    units = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001, "tenths of a millimetre": 1e-4}
    fits = [(u, s) for u, s in units.items() if s != scale and 0.2 <= raw_median * s <= 3.0]
    fits.sort(key=lambda unit: unit[1] != 0.001)
    advice = (
        f"it looks like {fits[0][0]}; pass --depth-scale {fits[0][1]:g}"
        if fits
        else "pass --depth-scale with the metres per unit of this file"
    )
    what = "float depth, taken as metres" if is_float and scale == 1.0 else f"depth scale {scale:g} m per unit"
    far = median > FAR_LIMIT_M or near > REACH_LIMIT_M
    raise InputError(
        f"depth {path} cannot be right: its median is {median:.4g} m and its nearest twentieth begins at {near:.4g} m, "
        f"too {'far' if far else 'near'} to grasp ({what}); {advice}"
    )


def _read_workspace(path: Path | Upload, depth: Array) -> Mask:
    if path.suffix.lower() == ".npy":
        pixels = _load_npy(path, "workspace mask")
    else:
        image = _open(path, "workspace mask")
        if image.format == "JPEG":
            raise InputError(f"workspace mask {path} is a JPEG, whose edges are not exact; save it as PNG")
        if image.mode in ("P", "PA", "RGBA", "RGBX", "CMYK"):
            image = _decoded(image, path, "workspace mask").convert("RGB")
        elif image.mode == "LA":
            image = _decoded(image, path, "workspace mask").convert("L")
        pixels = _pixels(image, path, "workspace mask")
    mask = np.asarray(pixels) != 0
    if mask.ndim == 3:
        mask = mask.any(axis=2)
    if mask.shape != depth.shape:
        got = f"{mask.shape[1]}x{mask.shape[0]}" if mask.ndim == 2 else str(mask.shape)
        raise InputError(f"workspace mask {path} is {got} but the images are {depth.shape[1]}x{depth.shape[0]}")
    if not mask.any():
        raise InputError(f"the workspace mask allows no pixel ({path} is all zero)")
    if not (mask & (depth > 0)).any():
        raise InputError(f"the workspace mask allows no pixel with depth ({path})")
    return mask


def read_npy(data: bytes) -> NDArray[np.generic]:
    """Read an array from the content of a .npy file without unpickling anything.

    Raises:
        ValueError: The header is broken, asks for objects, or does not fit the length of the data.
    """
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(file)
    elif version == (2, 0):
        shape, is_fortran, dtype = np.lib.format.read_array_header_2_0(file)
    else:
        raise ValueError(f"its format version {version} is not supported")
    if dtype.hasobject or dtype.fields is not None:
        raise ValueError(f"it holds {dtype}, not numbers")
    size = math.prod(shape) * dtype.itemsize
    if size != len(data) - file.tell() or any(side < 0 for side in shape):
        raise ValueError(f"its header asks for {size} bytes of {shape} {dtype}, but {len(data) - file.tell()} follow")
    return np.frombuffer(data, dtype, offset=file.tell()).reshape(shape, order="F" if is_fortran else "C")


def _located(source: Source) -> Path | Upload:
    return Path(source) if isinstance(source, str) else source


def _intrinsics(calibration: Calibration, size_wh: tuple[int, int], path: Source) -> CameraIntrinsics:
    try:
        return calibration.intrinsics(size_wh)
    except InputError as error:
        raise InputError(f"camera file {path}: {error}") from error


def _open(path: Path | Upload, what: str) -> Image.Image:
    if isinstance(path, Path):
        require_file(path, f"{what} image")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            image = Image.open(io.BytesIO(path.read_bytes() if isinstance(path, Path) else path.data))
        except Exception as error:  # decoders raise many types on broken data
            raise _undecodable(path, what, error) from error
    if image.width * image.height > MAX_PIXELS:
        raise InputError(
            f"{what} image {path} is {image.width}x{image.height}; at most {MAX_PIXELS // 10**6} megapixels are allowed"
        )
    return image


def _decoded(image: Image.Image, path: Path | Upload, what: str) -> Image.Image:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            image.load()
        except Exception as error:  # decoders raise many types on broken data
            raise _undecodable(path, what, error) from error
    return image


def _pixels(image: Image.Image, path: Path | Upload, what: str) -> NDArray[np.generic]:
    return np.array(_decoded(image, path, what))


def _undecodable(path: Path | Upload, what: str, error: Exception) -> InputError:
    if isinstance(error, Image.DecompressionBombError):
        reason = f"it is larger than the {MAX_PIXELS // 10**6} megapixels allowed"
    elif isinstance(error, Image.UnidentifiedImageError):
        reason = "it is no image of a known format (PNG, TIFF, JPEG, ... or .npy)"
    else:
        reason = str(error) or type(error).__name__
    return InputError(f"{what} image {path} cannot be decoded: {reason}")


def _load_npy(path: Path | Upload, what: str) -> NDArray[np.generic]:
    if isinstance(path, Path):
        require_file(path, f"{what} array")
    try:
        if isinstance(path, Upload):
            return read_npy(path.data)
        array = np.lib.format.open_memmap(path, mode="r")
        if array.size > 4 * MAX_PIXELS:
            raise ValueError(f"its shape {array.shape} is too large")
        return np.array(array)
    except Exception as error:  # the header parser raises many types on broken data
        raise InputError(f"{what} array {path} is not a readable .npy file: {error}") from error
