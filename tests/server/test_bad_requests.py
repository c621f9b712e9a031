"""A table of requests that cannot be answered, over real sockets: a 4xx in JSON each, and a server that lives on."""

from __future__ import annotations

import base64
import io
import json
import socket
import struct
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from fakes.grasp_server import Running, json_of, npy, offline_recipe, parts_of, png, running
from PIL import Image

from thinkgrasp.server.app import ServerOptions
from thinkgrasp.server.limits import Limits
from thinkgrasp.server.paper_api import PaperOptions
from thinkgrasp.testing import sample_frame

LIMITS = Limits(body_mb=3, megapixels=0.4, body_timeout_s=0.6, header_timeout_s=0.6, episodes=200)
Files = dict[str, tuple[str, bytes, str]]


@dataclass(frozen=True)
class Answer:
    status: int
    body: bytes


Ask = Callable[[Running], Answer]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """The folder that /grasp_pose may read, with a secret beside it and links out of it."""
    base = tmp_path_factory.mktemp("paper")
    root = base / "root"
    root.mkdir()
    frame = sample_frame()
    (root / "image.png").write_bytes(png(frame.color))
    (root / "depth.png").write_bytes(png(np.rint(frame.depth * 1000).astype(np.uint16)))
    (root / "text.txt").write_text("the red box")
    (base / "secret.txt").write_text("the red box")
    (root / "link.txt").symlink_to(base / "secret.txt")
    (root / "up").symlink_to(base)
    (root / "folder").mkdir()
    (root / "loop").symlink_to(root / "loop")
    return root


@pytest.fixture(scope="module")
def server(folder: Path):
    with running(offline_recipe(LIMITS), ServerOptions(limits=LIMITS, paper=PaperOptions(folder))) as found:
        yield found


def posted(path: str = "/v1/grasp", method: str = "POST", **more: object) -> Ask:
    def ask(server: Running) -> Answer:
        answer = server.http.request(method, path, **more)  # type: ignore[arg-type]
        return Answer(answer.status_code, answer.content)

    return ask


def with_part(**changes: bytes | str | None) -> Ask:
    """A good multipart request with parts replaced, or left out (None)."""
    files: Files = parts_of(sample_frame())
    for name, value in changes.items():
        if value is None:
            del files[name]
        else:
            files[name] = (name, value if isinstance(value, bytes) else value.encode(), "application/octet-stream")
    return posted(files=files)


def with_json(**changes: object) -> Ask:
    """A good JSON request with values replaced; no text may take the place of a number, and so on."""
    return posted(json=json_of(sample_frame()) | changes)


def raw(*chunks: bytes, wait_s: float = 0.0, shut: bool = False) -> Ask:
    """Bytes on a socket, some time after one another, and what comes back."""

    def ask(server: Running) -> Answer:
        with socket.create_connection(("127.0.0.1", server.port), 10) as connection:
            for i, chunk in enumerate(chunks):
                if i:
                    time.sleep(wait_s)
                try:
                    connection.sendall(chunk)
                except OSError:
                    break
            if shut:
                connection.shutdown(socket.SHUT_WR)
            connection.settimeout(20)
            data = b""
            while more := connection.recv(65536):
                data += more
                head, _, body = data.partition(b"\r\n\r\n")
                length = next(
                    (int(x.split(b":")[1]) for x in head.split(b"\r\n") if x.lower().startswith(b"content-length")),
                    None,
                )
                if length is not None and len(body) >= length:
                    break
        head, _, body = data.partition(b"\r\n\r\n")
        return Answer(int(head.split()[1]) if head else 0, body)

    return ask


def bomb(width: int, height: int) -> bytes:
    """A small PNG whose header claims to be huge, and whose data would fill it with zeros."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    data = zlib.compress(bytes(10_000_000), 9)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def spoilt(data: bytes) -> bytes:
    """The same with a tenth of it overwritten in the middle."""
    middle, tenth = len(data) // 2, len(data) // 10
    return data[:middle] + bytes(tenth) + data[middle + tenth :]


def npy_header(shape: object, descr: str = "'<f4'") -> bytes:
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}"
    text += " " * (63 - (len(text) + 10) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def camera(**changes: object) -> dict[str, object]:
    found = {"width": 320, "height": 240, "fx": 295.0, "fy": 295.0, "cx": 159.5, "cy": 119.5} | changes
    return {k: v for k, v in found.items() if v is not None}


def tiff(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(array).save(buffer, "TIFF")
    return buffer.getvalue()


FRAME = sample_frame()
DEPTH_MM = np.rint(FRAME.depth * 1000).astype(np.uint16)
MULTIPART = "multipart/form-data; boundary=b"
HEAD = b"POST /v1/grasp HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
PATHS = {"image_path": "image.png", "depth_path": "depth.png", "text_path": "text.txt"}
UNKNOWN = "/v1/episodes/AAAAAAAAAAAAAAAAAAAAAA"

BAD: dict[str, tuple[int | tuple[int, ...], Ask]] = {
    # addresses and methods
    "no such address": (404, posted("/v1/grab")),
    "upward address": (404, raw(b"GET /page/../../../../etc/passwd HTTP/1.1\r\nHost: localhost\r\n\r\n")),
    "upward address, encoded": (404, posted("/page/..%2f..%2f__init__.py", "GET")),
    "upward address, twice encoded": (404, posted("/page/%252e%252e%252fapp.py", "GET")),
    "a slash too many": (404, posted("/v1/grasp/", files=parts_of(sample_frame()))),
    "a slash too many on a page": (404, posted("/docs/", "GET")),
    "NUL in the address": (404, posted("/page/%00", "GET")),
    "wrong method": (405, posted("/v1/grasp", "GET")),
    "wrong method on a page": (405, posted("/healthz", "POST", json={})),
    "unknown method": (405, posted("/v1/grasp", "BREW")),
    "foreign page": (403, posted(json={}, headers={"Origin": "http://evil.example"})),
    "page of no origin": (403, posted(json={}, headers={"Origin": "null"})),
    "foreign host name": (403, posted("/healthz", "GET", headers={"Host": "evil.example:80"})),
    # bodies
    "no body": (415, posted()),
    "empty JSON body": (400, posted(content=b"", headers={"Content-Type": "application/json"})),
    "broken JSON": (400, posted(content=b'{"color": ', headers={"Content-Type": "application/json"})),
    "JSON in another encoding": (400, posted(content=b"\xff\xfe\x00", headers={"Content-Type": "application/json"})),
    "NaN in JSON": (400, posted(content=b'{"camera": {"fx": NaN}}', headers={"Content-Type": "application/json"})),
    "deep JSON": (400, posted(content=b"[" * 100_000, headers={"Content-Type": "application/json"})),
    "deep JSON, closed": (
        400,
        posted(content=b'{"a":' * 500 + b"1" + b"}" * 500, headers={"Content-Type": "application/json"}),
    ),
    "huge number in JSON": (
        400,
        posted(content=b'{"x": ' + b"9" * 9000 + b"}", headers={"Content-Type": "application/json"}),
    ),
    "millions of values in JSON": (
        400,
        posted(content=b'{"color": [' + b"1," * 1_400_000 + b"1]}", headers={"Content-Type": "application/json"}),
    ),
    "thousands of keys in a part": (400, with_part(camera=json.dumps({f"{i}": 0 for i in range(9000)}))),
    "a list": (400, posted(json=[1, 2])),
    "a text": (400, posted(json="grasp")),
    "another type": (415, posted(content=b"hello", headers={"Content-Type": "text/plain"})),
    "a form": (415, posted(data={"instruction": "the red box"})),
    "compressed": (415, posted(json={}, headers={"Content-Encoding": "gzip"})),
    "multipart without boundary": (400, posted(content=b"x", headers={"Content-Type": "multipart/form-data"})),
    "multipart that is none": (400, posted(content=b"hello", headers={"Content-Type": MULTIPART})),
    "multipart cut off": (
        (400, 422),
        posted(content=b'--b\r\nContent-Disposition: form-data; name="color"', headers={"Content-Type": MULTIPART}),
    ),
    "multipart part without a name": (
        400,
        posted(
            content=b"--b\r\nContent-Disposition: form-data\r\n\r\nx\r\n--b--\r\n", headers={"Content-Type": MULTIPART}
        ),
    ),
    "a part in another alphabet": (
        422,
        posted(
            content=b'--b\r\nContent-Disposition: form-data; name="color"\r\n\r\n+2AA-\r\n--b--\r\n',
            headers={"Content-Type": f"{MULTIPART}; charset=utf-7"},
        ),
    ),
    "multipart with a boundary that is none": (
        400,
        posted(content=b"x", headers={"Content-Type": 'multipart/form-data; boundary="\xff"'.encode("latin-1")}),
    ),
    "a part twice": (400, posted(files=[*parts_of(FRAME).items(), ("instruction", ("i", b"again", "text/plain"))])),
    "a hundred parts": (400, posted(files={f"part{i}": (f"{i}", b"x", "text/plain") for i in range(100)})),
    "an unknown part": (422, with_part(robot="ur5")),
    "too large, and says so": (413, posted(content=bytes(3_100_000), headers={"Content-Type": "application/json"})),
    "too large, in pieces": (
        413,
        posted(content=(bytes(100_000) for _ in range(40)), headers={"Content-Type": "application/json"}),
    ),
    # what is missing
    "no color": (422, with_part(color=None)),
    "no depth": (422, with_part(depth=None)),
    "no camera": (422, with_part(camera=None)),
    "no instruction": (422, with_part(instruction=None)),
    "empty instruction": (422, with_part(instruction="  ")),
    "long instruction": (422, with_part(instruction="x" * 3000)),
    "instruction that is no text": (400, with_part(instruction=b"\xff\xfe")),
    "instruction that is no text, as a field": (
        400,
        posted(
            content=b'--b\r\nContent-Disposition: form-data; name="instruction"\r\n\r\n\xff\xfe\r\n--b--\r\n',
            headers={"Content-Type": MULTIPART},
        ),
    ),
    "half a character": (
        (400, 422),
        posted(
            content=json.dumps(json_of(FRAME) | {"instruction": "\ud83c box"}).encode(),
            headers={"Content-Type": "application/json"},
        ),
    ),
    "instruction of another type": (422, with_json(instruction=7)),
    # pictures
    "color that is no image": (422, with_part(color="hello")),
    "color cut off": (422, with_part(color=png(FRAME.color)[:900])),
    "color with broken data": (422, with_part(color=spoilt(png(FRAME.color)))),
    "color as GIF": (422, with_part(color=b"GIF89a" + bytes(40))),
    "color as SVG": (422, with_part(color='<svg xmlns="http://www.w3.org/2000/svg" width="9" height="9"/>')),
    "color of another size": (422, with_part(color=png(FRAME.color[:100]))),
    "huge color": (413, with_part(color=png(np.zeros((700, 700, 3), np.uint8)))),
    "tiny color": (422, with_part(color=png(FRAME.color[:1, :1]))),
    "empty color": (422, with_part(color=b"")),
    "bomb": (413, with_part(color=bomb(60_000, 60_000))),
    "bomb beyond all sizes": (413, with_part(color=bomb(2**31 - 1, 2**31 - 1))),
    "bomb as depth": (413, with_part(depth=bomb(20_000, 20_000))),
    "color not base64": (422, with_json(color="***")),
    "color as a number": (422, with_json(color=5)),
    "color as a list of numbers": (422, with_json(color=[1, 2, 3])),
    # depth
    "depth that is no image": (422, with_part(depth="hello")),
    "depth as a colour picture": (422, with_part(depth=png(FRAME.color))),
    "depth of 8 bits": (422, with_part(depth=png(FRAME.color[..., 0]))),
    "depth as JPEG": (422, with_part(depth=b"\xff\xd8\xff\xe0" + bytes(60))),
    "depth of another size": (422, with_part(depth=png(DEPTH_MM[:100]))),
    "depth all zero": (422, with_part(depth=npy(np.zeros_like(FRAME.depth)))),
    "depth all NaN": (422, with_part(depth=npy(np.full_like(FRAME.depth, np.nan)))),
    "depth all infinite": (422, with_part(depth=npy(np.full_like(FRAME.depth, np.inf)))),
    "depth negative": (422, with_part(depth=npy(-FRAME.depth))),
    "depth in millimetres as floats": (422, with_part(depth=npy(FRAME.depth * 1000))),
    "depth of complex numbers": (422, with_part(depth=npy(FRAME.depth.astype(complex)))),
    "depth of objects": (422, with_part(depth=npy(np.array([[object()] * 9] * 9)))),
    "depth with pickled code": (422, with_part(depth=npy_header((300, 300), "'|O'") + b"cos\nsystem\n(S'id'\ntR.")),
    "depth with too little data": (422, with_part(depth=npy_header((240, 320)) + bytes(100))),
    "depth with a huge header": (413, with_part(depth=npy_header((10**9, 10**9)) + bytes(100))),
    "depth with a negative size": (422, with_part(depth=npy_header((-240, 320)) + bytes(100))),
    "depth with no size": (422, with_part(depth=npy_header(()) + bytes(4))),
    "depth with a broken header": (422, with_part(depth=b"\x93NUMPY\x01\x00\xff\xff{{{{")),
    "depth of three dimensions": (422, with_part(depth=npy(np.zeros((240, 320, 3), np.float32)))),
    "depth in another unit": (422, with_json(depth=base64.b64encode(npy(FRAME.depth * 1e-3)).decode())),
    # camera
    "camera that is no JSON": (400, with_part(camera="fx=600")),
    "camera as a list": (422, with_part(camera="[600, 600]")),
    "camera without a focal length": (422, with_json(camera=camera(fx=None))),
    "camera with a negative focal length": (422, with_json(camera=camera(fx=-1))),
    "camera with a text": (422, with_json(camera=camera(fx="600"))),
    "camera with a boolean": (422, with_json(camera=camera(fx=True))),
    "camera with an infinite number": (
        422,
        posted(
            content=json.dumps(json_of(FRAME) | {"camera": camera()}).replace("295.0", "1e999").encode(),
            headers={"Content-Type": "application/json"},
        ),
    ),
    "camera of another size": (422, with_json(camera=camera(width=640, height=480, cx=320, cy=240))),
    "camera with its centre outside": (422, with_json(camera=camera(cx=5000))),
    "camera with distortion": (422, with_json(camera=camera(coeffs=[0.1, 0, 0, 0, 0]))),
    "camera with a scale of zero": (422, with_part(camera=json.dumps(camera(depth_scale=0)), depth=png(DEPTH_MM))),
    "camera with a pose that is none": (422, with_json(camera=camera(T_world_camera=[[1, 0], [0, 1]]))),
    "camera with a pose that scales": (422, with_json(camera=camera(T_world_camera=(3 * np.eye(4)).tolist()))),
    # options
    "unknown option": (422, with_json(options={"planner": "openai"})),
    "a setting that is the server's": (422, with_json(options={"weights": "/etc/passwd"})),
    "seed that is no number": (422, with_json(options={"seed": "one"})),
    "negative seed": (422, with_json(options={"seed": -1})),
    "n_nearest of zero": (422, with_json(options={"n_nearest": 0})),
    "infinite stand-off": (
        400,
        posted(content=b'{"options": {"standoff_m": Infinity}}', headers={"Content-Type": "application/json"}),
    ),
    "wrong unit": (422, with_json(options={"depth_scale": 1000})),
    "options as a text": (422, with_json(options="fast")),
    "workspace of another size": (422, with_part(workspace=png(np.ones((10, 10), np.uint8)))),
    "workspace that allows nothing": (422, with_part(workspace=png(np.zeros(FRAME.depth.shape, np.uint8)))),
    # episodes
    "episode without an instruction": (422, posted("/v1/episodes", json={})),
    "episode without an attempt": (422, posted("/v1/episodes", json={"instruction": "a", "step_limit": 0})),
    "episode as a form": (415, posted("/v1/episodes", data={"instruction": "a"})),
    "episode of a megabyte": (413, posted("/v1/episodes", json={"instruction": "x" * 1_000_000})),
    "episode of a megabyte, in pieces": (
        413,
        posted(
            "/v1/episodes",
            content=(bytes(50_000) for _ in range(20)),
            headers={"Content-Type": "application/json"},
        ),
    ),
    "no such episode": (404, posted(UNKNOWN, "GET")),
    "end of no such episode": (404, posted(UNKNOWN, "DELETE")),
    "frame for no such episode": (
        404,
        posted(f"{UNKNOWN}/observe", files={k: v for k, v in parts_of(FRAME).items() if k != "instruction"}),
    ),
    "outcome of no such episode": (404, posted(f"{UNKNOWN}/outcome", json={"success": True})),
    "outcome without success": (422, posted(f"{UNKNOWN}/outcome", json={"reason": "held"})),
    "outcome that contradicts itself": (422, posted(f"{UNKNOWN}/outcome", json={"success": False, "delivered": True})),
    "outcome with half a frame": (422, posted(f"{UNKNOWN}/outcome", json={"success": True, "color": "AAAA"})),
    "outcome with markup as a reason": (422, posted(f"{UNKNOWN}/outcome", json={"success": False, "reason": "<b>"})),
    # the paper's interface
    "paper: no body": (415, posted("/grasp_pose")),
    "paper: paths missing": (400, posted("/grasp_pose", json={"image_path": "image.png"})),
    "paper: path of another type": (400, posted("/grasp_pose", json=PATHS | {"text_path": 5})),
    "paper: path upwards": (400, posted("/grasp_pose", json=PATHS | {"text_path": "../secret.txt"})),
    "paper: path from the top": (400, posted("/grasp_pose", json=PATHS | {"text_path": "/etc/passwd"})),
    "paper: link to a file outside": (400, posted("/grasp_pose", json=PATHS | {"text_path": "link.txt"})),
    "paper: through a link outside": (400, posted("/grasp_pose", json=PATHS | {"text_path": "up/secret.txt"})),
    "paper: endless link": (400, posted("/grasp_pose", json=PATHS | {"text_path": "loop"})),
    "paper: a folder": (400, posted("/grasp_pose", json=PATHS | {"text_path": "folder"})),
    "paper: a device": (400, posted("/grasp_pose", json=PATHS | {"text_path": "/dev/zero"})),
    "paper: NUL in a path": (400, posted("/grasp_pose", json=PATHS | {"text_path": "text.txt\x00.png"})),
    "paper: endless path": (400, posted("/grasp_pose", json=PATHS | {"text_path": "a/" * 5000})),
    "paper: no such file": (400, posted("/grasp_pose", json=PATHS | {"text_path": "nothing.txt"})),
    "paper: no camera of that size": (400, posted("/grasp_pose", json=PATHS)),
    "paper: a part missing": (400, posted("/grasp_pose", files={"image": ("i", b"x", "image/png")})),
    "paper: text in another alphabet": (
        400,
        posted(
            "/grasp_pose",
            content=b"".join(
                b'--b\r\nContent-Disposition: form-data; name="%s"\r\n\r\n+2AA-\r\n' % name
                for name in (b"image", b"depth", b"text")
            )
            + b"--b--\r\n",
            headers={"Content-Type": f"{MULTIPART}; charset=utf-7"},
        ),
    ),
    "paper: no image": (
        400,
        posted("/grasp_pose", files={n: (n, b"x", "image/png") for n in ("image", "depth", "text")}),
    ),
    "paper: nothing of that kind": (
        400,
        posted(
            "/grasp_pose",
            files={
                "image": ("i", png(FRAME.color), "image/png"),
                "depth": ("d", png(DEPTH_MM), "image/png"),
                "text": ("t", b"a bicycle", "text/plain"),
                "camera": ("c", json.dumps(camera()).encode(), "application/json"),
            },
        ),
    ),
    # bytes on the wire
    "no HTTP": (400, raw(b"hello there\r\n\r\n")),
    "TLS": (400, raw(b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(40) + b"\r\n\r\n")),
    "HTTP/x": (400, raw(b"GET / HTTP/x\r\nHost: localhost\r\n\r\n")),
    "no host": (400, raw(b"GET /healthz HTTP/1.1\r\n\r\n")),
    "headers without end": (400, raw(b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"a" * 200_000)),
    "two lengths": (400, raw(HEAD + b"Content-Length: 2\r\nContent-Length: 3\r\n\r\n{}")),
    "a negative length": (400, raw(HEAD + b"Content-Length: -2\r\n\r\n{}")),
    "a broken chunk": (400, raw(HEAD + b"Transfer-Encoding: chunked\r\n\r\nzz\r\n")),
    "an upgrade": (
        404,
        raw(b"GET /ws HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\r\n"),
    ),
    "silence": (408, raw(b"")),
    "slow loris in the headers": (408, raw(*[b"GET / HTTP/1.1\r\n", *[b"X: a\r\n"] * 4], wait_s=0.25)),
    "slow loris in the body": (408, raw(HEAD + b"Content-Length: 1000\r\n\r\n", *[b"{"] * 4, wait_s=0.25)),
    "less than was announced": (408, raw(HEAD + b"Content-Length: 1000\r\n\r\n{}")),
}


def assert_is_error(answer: Answer, status: int | tuple[int, ...], name: str, secrets: tuple[str, ...]) -> None:
    assert answer.status in (status if isinstance(status, tuple) else (status,)), (name, answer)
    assert 400 <= answer.status < 500
    error = json.loads(answer.body)["error"]
    said = error["message"] if isinstance(error, dict) else error
    assert said
    assert "Traceback" not in said
    for secret in secrets:
        assert secret not in answer.body.decode(), (name, said)


@pytest.mark.parametrize("name", BAD)
def test_a_bad_request_is_an_error_in_json(name: str, server: Running, folder: Path):
    status, ask = BAD[name]
    assert_is_error(ask(server), status, name, (str(folder.parent), str(Path(__file__).parents[2]), "/etc", "/tmp"))
    assert server.http.get("/readyz").status_code == 200


def test_the_table_is_long_enough():
    assert len(BAD) >= 60


def test_an_instruction_may_be_all_commas(server: Running):
    answer = server.http.post("/v1/grasp", json=json_of(FRAME, "," * 2000))
    assert answer.status_code == 200, answer.text
