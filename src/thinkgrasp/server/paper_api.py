"""The interface of the paper's own server: POST /grasp_pose with paths or files, answered in GraspNet's convention.

References:
    `realarm.py` in H-Freax/ThinkGrasp (paths in JSON, answer and errors), and its forks, which take uploads.
"""

from __future__ import annotations

import asyncio
import json
import os
import stat
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from starlette.requests import Request

from thinkgrasp.server.decoding import FrameUpload
from thinkgrasp.server.graspnet_pose import Pose
from thinkgrasp.server.limits import Limits
from thinkgrasp.server.problems import RequestProblem
from thinkgrasp.server.schema import PaperPose
from thinkgrasp.server.uploads import as_text, linger, read_body, read_json_object, read_parts

PATH_KEYS = ("image_path", "depth_path", "text_path")
FILE_PARTS = ("image", "depth", "text")
PUBLISHED_CAMERA = {"width": 640, "height": 480, "fx": 382.8567, "fy": 382.4391, "cx": 331.3490, "cy": 247.1126}
"""The camera that the paper's code names in its source, with depth in millimetres."""
PUBLISHED_CAMERA_WARNING = '299 - "no camera was given: the one of the paper\'s source was assumed"'

_OPEN_FLAGS = os.O_RDONLY | sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_BINARY"))


@dataclass(frozen=True)
class PaperOptions:
    """How a server answers the paper's clients."""

    root: Path | None = None
    """Folder that paths in requests must lie in; None = requests with paths are refused."""
    camera: bytes | None = None
    """Camera file for requests that bring none; None = the published camera, for its image size."""


@dataclass(frozen=True)
class PaperRequest:
    """What a client asked, with its files read."""

    frame: FrameUpload
    instruction: str
    is_camera_assumed: bool


async def read_paper_request(request: Request, options: PaperOptions, limits: Limits) -> PaperRequest:
    """Read a request in either form.

    Raises:
        RequestProblem: 400 for what the paper's server could not use either; 413, 415 and 408 as elsewhere.
        ClientLeft: The connection ended before the body.
    """
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind == "multipart/form-data":
        parts = await read_parts(request, limits)
        camera = parts.pop("camera", None)
        if set(parts) != set(FILE_PARTS):
            raise _bad(f"the parts must be {', '.join(FILE_PARTS)} and optionally camera")
        image, depth, text = (parts[name] for name in FILE_PARTS)
    elif kind == "application/json":
        data = read_json_object(await read_body(request, limits))
        said = data.pop("camera", None)
        camera = None if said is None else json.dumps(said).encode()
        if set(data) != set(PATH_KEYS) or not all(isinstance(value, str) for value in data.values()):
            raise _bad(f"the body must hold the texts {', '.join(PATH_KEYS)} and optionally the object camera")
        if options.root is None:
            raise _bad("this server reads no files by path; send the files, or start it with --paper-root DIR")
        image, depth, text = [
            await asyncio.to_thread(read_inside, options.root, data[key], key, limits.body_bytes) for key in PATH_KEYS
        ]
    else:
        await linger(request)
        raise RequestProblem(415, "unsupported_media_type", "send multipart/form-data or application/json")
    camera = options.camera if camera is None else camera
    is_assumed = camera is None
    frame = FrameUpload(image, depth, json.dumps(PUBLISHED_CAMERA).encode() if camera is None else camera)
    instruction = as_text(text, "text").strip()
    if not instruction:
        raise _bad("the text is empty; say what to take")
    return PaperRequest(frame, instruction, is_assumed)


def read_inside(root: Path, given: str, name: str, max_bytes: int) -> bytes:
    """Read a regular file that lies in a folder, after all links are followed.

    Raises:
        RequestProblem: 400; it does not, or cannot be read. The message is the same for both, and names no path.
    """
    refusal = _bad(f"{name} is no readable file inside the server's folder")
    try:
        base = root.resolve(strict=True)
        path = (base / given).resolve(strict=True)
        if not path.is_relative_to(base):
            raise refusal
        handle = os.open(path, _OPEN_FLAGS)
        with os.fdopen(handle, "rb") as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise refusal
            if status.st_size > max_bytes:
                raise RequestProblem(413, "too_large", f"{name} is larger than {max_bytes / 1e6:g} MB")
            return file.read(max_bytes)
    except (OSError, ValueError, RuntimeError):
        raise refusal from None


def published_pose(pose: Pose) -> PaperPose:
    """Return a grasp as the paper's server does."""
    a, b, c = map(_triple, pose.rot)
    return PaperPose(xyz=_triple(pose.xyz), rot=(a, b, c), dep=round(pose.dep, 9))


def _triple(values: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = (round(float(v), 9) for v in values)
    return x, y, z


def _bad(message: str) -> RequestProblem:
    return RequestProblem(400, "bad_request", message)
