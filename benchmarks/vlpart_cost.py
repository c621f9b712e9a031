"""Time and memory of VLPart at full size (Swin-B) with random weights.

    python benchmarks/vlpart_cost.py [--threads 2] [--width 640 --height 480] [--device cpu] [--dtype float32]

Each row runs in a fresh process, so that its peak memory (resident, with torch and the image) is its own. The weights
go through a file, as real ones do. Rows: names from a table, and from CLIP's RN50 text tower. Columns: reading the
weights; the first image; the median of further images; a second name for an image that has been looked at; four
new names. Random weights do the work of trained ones, except that most of their proposals are small.
"""

from __future__ import annotations

import json
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

from thinkgrasp.networks.part_finder import PartFinder, TextSource
from thinkgrasp.networks.vlpart import VLPart, VLPartConfig

NAMES = ("mug:handle", "scissors:blade", "bottle:cap", "knife:handle")
TOWER = {"width": 512, "layers": 12, "vocabulary": 49408, "out": 1024}

COLUMNS = ("load s", "first s", "image s", "(best)", "2nd name", "4 names", "peak GiB", "GPU GiB")


def random_weights(shapes: dict[str, torch.Size]) -> dict[str, torch.Tensor]:
    """Return weights that keep the size of what passes through them."""
    g = torch.Generator().manual_seed(0)
    weights: dict[str, torch.Tensor] = {}
    for name, shape in shapes.items():
        if len(shape) == 1:
            weights[name] = torch.zeros(shape) if name.endswith("bias") else torch.ones(shape)
        else:
            weights[name] = torch.randn(shape, generator=g) * shape[1:].numel() ** -0.5
    return weights


def tower_shapes() -> dict[str, torch.Size]:
    """Return the shapes of CLIP's RN50 text tower as a VLPart checkpoint names them."""
    width = TOWER["width"]
    shapes = {
        "token_embedding.weight": (TOWER["vocabulary"], width),
        "positional_embedding": (77, width),
        "ln_final.weight": (width,),
        "ln_final.bias": (width,),
        "text_projection": (width, TOWER["out"]),
    }
    for n in range(TOWER["layers"]):
        for layer, (out, into) in {
            "attn.in_proj_": (3 * width, width),
            "attn.out_proj.": (width, width),
            "mlp.c_fc.": (4 * width, width),
            "mlp.c_proj.": (width, 4 * width),
        }.items():
            shapes |= {f"transformer.resblocks.{n}.{layer}weight": (out, into)}
            shapes |= {f"transformer.resblocks.{n}.{layer}bias": (out,)}
        for norm in ("ln_1", "ln_2"):
            shapes |= {f"transformer.resblocks.{n}.{norm}.{part}": (width,) for part in ("weight", "bias")}
    return {f"text_encoder.{name}": torch.Size(shape) for name, shape in shapes.items()}


def write_files(folder: Path, config: VLPartConfig) -> None:
    """Write a checkpoint without and with a text tower, a table of NAMES, and a tokeniser of single letters."""
    with torch.device("meta"):
        shapes = {name: value.shape for name, value in VLPart(config).state_dict().items()}
    weights = random_weights(shapes)
    torch.save({"model": weights}, folder / "table.pth")
    torch.save({"model": weights | random_weights(tower_shapes())}, folder / "tower.pth")
    rows = np.random.default_rng(0).normal(size=(len(NAMES), TOWER["out"]))
    np.savez(folder / "table.npz", names=np.array(NAMES), features=rows)
    letters = [chr(c) + end for c in range(33, 127) for end in ("", "</w>")]
    filler = [f"<{i}>" for i in range(TOWER["vocabulary"] - len(letters) - 2)]
    vocabulary = [*letters, *filler, "<|startoftext|>", "<|endoftext|>"]
    (folder / "vocab.json").write_text(json.dumps({token: i for i, token in enumerate(vocabulary)}))
    (folder / "merges.txt").write_text("#version: 0.2\n")


def seconds(call: Callable[[], object], device: str) -> float:
    """Return how long a call takes, until its device has finished."""
    start = time.perf_counter()
    call()
    if device != "cpu":
        torch.cuda.synchronize()
    return time.perf_counter() - start


@dataclass(frozen=True)
class Setting:
    """What is measured."""

    threads: int = 2
    width: int = 640
    height: int = 480
    images: int = 3
    """After the first."""
    device: str = "cpu"
    dtype: str = "float32"


def measure(folder: Path, text: str, setting: Setting, config: VLPartConfig) -> list[float]:
    """Return the columns: times [s], peak memory [GiB] of the process and on the device."""
    torch.set_num_threads(setting.threads)
    device = setting.device
    rng = np.random.default_rng(0)
    size = (setting.height, setting.width, 3)
    frames = [rng.integers(0, 256, size, dtype=np.uint8) for _ in range(setting.images + 1)]
    source = TextSource(table=folder / "table.npz") if text == "table" else TextSource(tokenizer=folder)
    start = time.perf_counter()
    finder = PartFinder(folder / f"{text}.pth", source, config=config, device=device, dtype=setting.dtype)
    load = time.perf_counter() - start
    cold, *further = [seconds(lambda f=frame: finder.find(f, NAMES[:1]), device) for frame in frames]
    phrase = seconds(lambda: finder.find(frames[-1], NAMES[1:2]), device)
    new_names = [f"new {name}" for name in NAMES] if text == "tower" else NAMES
    names = seconds(lambda: finder.find(frames[-1], new_names), device)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    on_device = 0.0 if device == "cpu" else torch.cuda.max_memory_allocated() / 2**30
    return [load, cold, float(np.median(further)), float(min(further)), phrase, names, peak, on_device]


def main(setting: Setting) -> None:
    """Print the table."""
    print(f"{setting.width}x{setting.height} {setting.dtype} {setting.device}, {setting.threads} threads")
    print(f"{'text':6s} " + " ".join(f"{c:>9s}" for c in COLUMNS))
    context = multiprocessing.get_context("spawn")
    config = VLPartConfig()
    with tempfile.TemporaryDirectory() as scratch:
        with context.Pool(1) as pool:
            pool.apply(write_files, (Path(scratch), config))
        for text in ("table", "tower"):
            with context.Pool(1) as pool:
                row = pool.apply(measure, (Path(scratch), text, setting, config))
            print(f"{text:6s} " + " ".join(f"{v:9.3f}" for v in row), flush=True)


if __name__ == "__main__":
    main(tyro.cli(Setting))
