"""What asking a vision-language model costs on our side: time per decision, and tokens per step, at 640x480.

    python benchmarks/vlm_overhead.py

Time: the whole of `plan` (mark, encode, ask over HTTP, parse, check against the scene) with a server in another process
that replies at once, so that what is left is ours; then its parts by themselves. Tokens: text by OpenAI's o200k_base
where the package rs-bpe is installed (pip install rs-bpe), else 4 characters each; pictures by GPT-4o's published rule.
The piles are those of two tasks of the simulator.
"""

from __future__ import annotations

import importlib
import json
import multiprocessing
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import tyro

from thinkgrasp.benchmark.chat import image_tokens
from thinkgrasp.config import make_pipeline
from thinkgrasp.memory import Memory
from thinkgrasp.planners.openai_compatible import MARKS_IMAGE_WIDTH, PAPER_IMAGE_WH, OpenAIPlanner
from thinkgrasp.planners.parsing import parse_reply
from thinkgrasp.planners.prompts import Prompt, marks_prompt, paper_prompt, to_frame
from thinkgrasp.planners.vlm.chat import Question
from thinkgrasp.planners.vlm.support import freed, on_scene
from thinkgrasp.sim.tasks import find_task
from thinkgrasp.testbed import Session
from thinkgrasp.types import Scene

TASKS = ("clutter-06-fruit", "heavy-05-fruit_hard")
STYLES = ("marks", "paper", "paper, 640 wide")


def prompt_of(style: str, scene: Scene, instruction: str) -> Prompt:
    """Return the prompt of a style with an empty memory."""
    if style == "marks":
        return marks_prompt(scene, instruction, Memory(), image_width=MARKS_IMAGE_WIDTH)
    h, w = scene.frame.depth.shape
    return paper_prompt(
        scene, instruction, Memory(), image_wh=(640, 640 * h // w) if "640" in style else PAPER_IMAGE_WH
    )


def reply_of(style: str, scene: Scene, prompt: Prompt) -> str:
    """Return a usual reply about the first thing, with six things considered."""
    listed = scene.proposals[:6]
    if style == "marks":
        objects = [{"name": f"red thing {p.mark}", "mark": p.mark, "grasp_score": 80, "cell": 5} for p in listed]
        rationale = "Nothing lies on it or hides it, and its middle is free on both sides, so that it can be taken now."
        data = {"rationale": rationale, "visible": True, "target": "red thing", "mark": 1, "role": "goal",
                "kind": "object", "cell": 5, "objects": objects}  # fmt: skip
        return json.dumps(data)
    box = tuple(round(side * prompt.scale) for side in scene.proposals[0].box_xyxy)
    lines = [f"- red thing {p.mark}: grasp score 80, preferred cell 5" for p in listed]
    return "\n".join(["Goal visible: yes", "Selected object: red thing 1", f"Cropping box: {box}", "Objects:", *lines])


def answer_at_once(reply: str, port: Connection) -> None:
    """Serve one completion for every request, until the process is ended."""
    message = {"role": "assistant", "content": reply}
    usage = {"prompt_tokens": 1000, "completion_tokens": 100, "total_tokens": 1100}
    completion = {
        "id": "0",
        "object": "chat.completion",
        "created": 0,
        "model": "at-once",
        "usage": usage,
        "choices": [{"index": 0, "message": message, "finish_reason": "stop"}],
    }
    data = json.dumps(completion).encode()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        disable_nagle_algorithm = True

        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, format: str, *args: Any) -> None:
            """Say nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    port.send(server.server_address[1])
    server.serve_forever()


def milliseconds(work: Callable[[], object], runs: int) -> list[float]:
    """Return the wall times of some runs after two that do not count [ms]."""
    times: list[float] = []
    for _ in range(runs + 2):
        start = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - start))
    return times[2:]


def whole_plan(style: str, scene: Scene, instruction: str, reply: str, runs: int) -> list[float]:
    """Return how long `plan` takes with a server that replies at once [ms]."""
    spawn = multiprocessing.get_context("spawn")
    here, there = spawn.Pipe()
    server = spawn.Process(target=answer_at_once, args=(reply, there), daemon=True)
    server.start()
    planner = OpenAIPlanner(
        base_url=f"http://127.0.0.1:{here.recv()}/v1",
        style="marks" if style == "marks" else "paper",
        image_width=640 if "640" in style else None,
    )
    plan = planner.plan(scene, instruction, Memory())
    if plan.degraded:
        raise SystemExit(f"the reply was not taken, so that this would measure something else: {plan.degraded}")
    times = milliseconds(lambda: planner.plan(scene, instruction, Memory()), runs)
    planner.close()
    server.terminate()
    return times


def parts(style: str, scene: Scene, instruction: str, prompt: Prompt, reply: str, runs: int) -> dict[str, float]:
    """Return the median of each part of our side by itself [ms]."""

    def encode() -> None:
        question = Question("m", prompt.system, prompt.text, prompt.image, schema=prompt.schema)
        json.dumps(question.body("json_schema"))

    def check() -> None:
        plan = parse_reply(reply, image_wh=(prompt.image.shape[1], prompt.image.shape[0]))
        plan = on_scene(to_frame(plan, prompt), scene, Memory())
        if style == "marks":
            freed(plan, scene, Memory())

    work = {"prompt": lambda: prompt_of(style, scene, instruction), "encode": encode, "parse and check": check}
    return {name: float(np.median(milliseconds(part, runs))) for name, part in work.items()}


def text_tokens(text: str) -> tuple[int, str]:
    """Return how many tokens a text has, and by which count."""
    try:
        encoder = importlib.import_module("rs_bpe.bpe").openai.o200k_base()
    except ModuleNotFoundError:
        return -(-len(text) // 4), "4 characters each"
    return len(encoder.encode(text)), "o200k_base"


def main(runs: int = 30) -> None:
    """Print two tables in Markdown.

    Args:
        runs: That count, of every measurement.
    """
    times = [
        "| pile | style | things | plan: median | 90 % within | prompt | encode | parse and check |",
        "|" + 8 * "---|",
    ]
    tokens = ["| pile | style | picture | text | picture, low | picture, high | reply | step, high |", "|" + 8 * "---|"]
    counted = ""
    for task in TASKS:
        session = Session(find_task(task).scene(0))
        instruction = session.scene.spec.instruction
        scene = make_pipeline("offline").decide(session.cameras[0].read(), instruction).scene
        for style in STYLES:
            prompt = prompt_of(style, scene, instruction)
            reply = reply_of(style, scene, prompt)
            plan = whole_plan(style, scene, instruction, reply, runs)
            split = parts(style, scene, instruction, prompt, reply, runs)
            shares = " | ".join(f"{ms:.1f} ms" for ms in split.values())
            times.append(f"| {task} | {style} | {len(scene.proposals)} | {np.median(plan):.1f} ms "
                         f"| {np.quantile(plan, 0.9):.1f} ms | {shares} |")  # fmt: skip
            h, w = prompt.image.shape[:2]
            schema = json.dumps(prompt.schema) if prompt.schema else ""
            text, counted = text_tokens(prompt.system + prompt.text + schema)
            answer, _ = text_tokens(reply)
            low, high = (image_tokens((w, h), detail) for detail in ("low", "high"))
            tokens.append(f"| {task} | {style} | {w}x{h} | {text} | {low} | {high} | {answer} "
                          f"| {text + high} + {answer} |")  # fmt: skip
    print("\n".join(times))
    print(f"\nText counted by {counted}, the reply's schema included:\n")
    print("\n".join(tokens))


if __name__ == "__main__":
    tyro.cli(main)
