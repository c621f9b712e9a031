"""How much the language's weights depend on the frames that they are judged by.

    python benchmarks/leave_one_out.py DIR [--samples 120] [--seed 0]

For each real frame of DIR (as for `real_frames.py`) the weights are searched at random around their priors so that the
instructions of all other frames come out best: those of `annotations.json`, the rephrased ones and the absent things
of `tests/data`. The weights found are then judged by the frame that was held out. Perception runs once per frame.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from real_frames import iou, load_scene

from thinkgrasp.language.grounding import ground
from thinkgrasp.language.query import parse
from thinkgrasp.language.wanted import Query
from thinkgrasp.language.weights import DEFAULT_WEIGHTS, Weights
from thinkgrasp.perception import GeometricPerception
from thinkgrasp.types import Scene

DATA = Path(__file__).parents[1] / "tests" / "data"
SPREAD = 0.35
"""Standard deviation of the logarithm of a sampled weight."""
FRACTIONS = ("min_score", "lone_described", "rival_discount", "any_color_fit", "odd_color_fit", "said_color")
"""Weights that stay below 1."""
SETS = ("annotated", "rephrased", "absent")


@dataclass(frozen=True, eq=False)
class Sentence:
    """One instruction of one frame, with the boxes that answer; none = absent."""

    group: str
    query: Query
    boxes: tuple[tuple[float, ...], ...]


def load(folder: Path) -> tuple[dict[str, Scene], dict[str, list[Sentence]]]:
    """Perceive every frame and read its instructions."""
    data = json.loads((folder / "annotations.json").read_text())
    files = (folder / "annotations.json", DATA / "real_rephrased.json", DATA / "real_absent.json")
    sentences: dict[str, list[Sentence]] = {name: [] for name in data["scenes"]}
    for group, file in zip(SETS, files, strict=True):
        for name, scene in json.loads(file.read_text())["scenes"].items():
            for entry in scene["instructions"]:
                boxes = tuple(tuple(b) for b in entry["target_xyxy"])
                sentences[name].append(Sentence(group, parse(entry["instruction"]), boxes))
    with tempfile.TemporaryDirectory() as out:
        frames = {name: load_scene(folder, name, data["camera"], Path(out)) for name in sentences}
    return {name: GeometricPerception().perceive(frame) for name, frame in frames.items()}, sentences


def judge(scene: Scene, sentences: list[Sentence], weights: Weights) -> dict[str, tuple[int, int]]:
    """Return right and asked per set."""
    counts: dict[str, tuple[int, int]] = dict.fromkeys(SETS, (0, 0))
    for sentence in sentences:
        best = next(iter(ground(scene, sentence.query, weights).fitting(weights.min_score)), None)
        if best is None or not sentence.boxes:
            right = best is None and not sentence.boxes
        else:
            right = max(iou(scene.proposal(best.mark).box_xyxy, box) for box in sentence.boxes) >= 0.5
        good, asked = counts[sentence.group]
        counts[sentence.group] = (good + right, asked + 1)
    return counts


def rate(counts: list[dict[str, tuple[int, int]]]) -> float:
    """Return the mean over the sets of the share that is right, over several frames."""
    shares = [sum(c[s][0] for c in counts) / max(sum(c[s][1] for c in counts), 1) for s in SETS]
    return float(np.mean(shares))


def sample(rng: np.random.Generator) -> Weights:
    """Draw weights around their priors, the defaults."""
    drawn = {name: value * float(np.exp(rng.normal(0, SPREAD))) for name, value in asdict(DEFAULT_WEIGHTS).items()}
    return replace(DEFAULT_WEIGHTS, **drawn | {name: min(drawn[name], 0.97) for name in FRACTIONS})


def main(folder: tyro.conf.Positional[Path], samples: int = 120, seed: int = 0) -> None:
    """Print, frame by frame, what held-out weights and the defaults get right."""
    scenes, sentences = load(folder)
    rng = np.random.default_rng(seed)
    tried = [DEFAULT_WEIGHTS, *(sample(rng) for _ in range(samples))]
    results = [{name: judge(scenes[name], sentences[name], w) for name in scenes} for w in tried]
    print(f"{'held out':10s} {'weights':12s} " + " ".join(f"{s:>10s}" for s in SETS) + "   other frames")
    chosen: list[dict[str, tuple[int, int]]] = []
    for held in scenes:
        others = [rate([r[name] for name in scenes if name != held]) for r in results]
        best = int(np.argmax(others[1:])) + 1
        chosen.append(results[best][held])
        for label, k in (("searched", best), ("defaults", 0)):
            cells = " ".join(f"{f'{a}/{b}':>10s}" for a, b in results[k][held].values())
            print(f"{held:10s} {label:12s} {cells}   {others[k]:.3f}")
    for label, found in (("searched", chosen), ("defaults", [results[0][n] for n in scenes])):
        total = " ".join(f"{f'{sum(c[s][0] for c in found)}/{sum(c[s][1] for c in found)}':>10s}" for s in SETS)
        print(f"{'all':10s} {label:12s} {total}")
    rates = [rate(list(r.values())) for r in results[1:]]
    print(f"all frames, {samples} random weights: mean rate {np.mean(rates):.3f}, worst {min(rates):.3f}, ", end="")
    print(f"best {max(rates):.3f}; defaults {rate(list(results[0].values())):.3f}")


if __name__ == "__main__":
    tyro.cli(main)
