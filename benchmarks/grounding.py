"""How often the offline language understands which thing is meant, on rendered scenes that nothing was tuned on.

    python benchmarks/grounding.py [--scenes 40] [--split development|test] [--failures]

Scenes, things and instructions are random; perception gets colour and depth only. Instructions come from the truth by
templates. Right means: the best match's mask has IoU >= 0.5 with a thing that truly answers. Only things that
perception found can be asked for, so that the measure is of the language. For what is absent, right means that nothing
is accepted as the goal. Constants may be judged by the development scenes only.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import tyro
from household import COLORS, Truth, height_m, random_thing, truth
from perception import KINDS, overlaps, random_scene, random_view

from thinkgrasp.language.grounding import ground
from thinkgrasp.language.query import parse
from thinkgrasp.perception import GeometricPerception
from thinkgrasp.sim import tabletop as t
from thinkgrasp.types import Scene

FIRST_SEED = {"development": 0, "test": 50_000}
VIEWS = ("apart", "touching", "depth-missing", "from-above")
NEAR_COLORS = {
    "red": "orange pink brown",
    "orange": "red yellow brown",
    "yellow": "orange",
    "green": "blue",
    "blue": "green purple",
    "purple": "blue pink",
    "white": "grey",
    "black": "grey blue",
}
"""Colours that light may turn one into: requests for an absent colour keep away from them."""
ABSENT = [
    "spoon",
    "fork",
    "knife",
    "hammer",
    "scissors",
    "screwdriver",
    "marker",
    "toothbrush",
    "pencil",
    "banana",
    "lemon",
    "apple",
    "orange",
    "pear",
    "carrot",
    "cucumber",
    "tennis ball",
    "bowl",
    "plate",
    "mug",
    "wine glass",
    "teddy bear",
    "elephant",
    "phone",
    "book",
    "cracker box",
    "sponge",
    "toy car",
    "computer mouse",
    "wrench",
    "drill",
    "bottle",
    "can",
    "ball",
]


@dataclass(frozen=True, eq=False)
class Case:
    """One perceived scene with its truth."""

    scene: Scene
    things: tuple[t.TableObject, ...]
    iou: np.ndarray
    """(things, proposals)"""
    found: tuple[int, ...]
    """Things that perception found."""
    image: np.ndarray
    """(things, 2) mask centres (u, v) [px]; NaN where not visible."""
    eye: np.ndarray
    """(3,) camera position in the world [m]."""


@dataclass(frozen=True)
class Question:
    """One instruction and the things that truly answer; none = absent."""

    template: str
    text: str
    answers: tuple[int, ...]


def make_case(kind: str, seed: int) -> Case:
    """Render and perceive one random scene."""
    rng = np.random.default_rng(seed)
    layout = random_scene(replace(KINDS[kind], objects=(5, 9)), rng, random_thing)
    camera, T = random_view(KINDS[kind], rng)
    rendering = t.render(layout, camera, T, rng=rng, dropout=KINDS[kind].dropout)
    scene = GeometricPerception().perceive(replace(rendering.frame, T_world_camera=None))
    iou = overlaps(scene, rendering)
    clear = np.array(rendering.visible_fraction) >= 0.5
    found = tuple(int(i) for i in np.nonzero(clear & (iou.max(axis=1, initial=0.0) >= 0.5))[0])
    masks = [rendering.mask(i) for i in range(len(layout.objects))]
    image = np.array([np.argwhere(m).mean(axis=0)[::-1] if m.any() else [np.nan] * 2 for m in masks])
    return Case(scene, layout.objects, iou, found, image, T[:3, 3])


Known = list[tuple[str, str, Truth]]
UNPAINTED = ("banana", "knife", "spoon", "hammer")
"""Things whose colour the drawn one does not change, or only a part of."""
WITH_DARK_PARTS = ("bottle", "drill", "hammer", "marker", "knife")


def questions(case: Case, rng: np.random.Generator) -> Iterator[Question]:
    """Ask for things that are there and for things that are not; the same question once."""
    known: Known = [truth(thing) for thing in case.things]
    asked: set[str] = set()
    for question in (*_about(case, known, rng), *_superlatives(case), *_absent(case, known, rng)):
        if question.text not in asked:
            asked.add(question.text)
            yield question


def _about(case: Case, known: Known, rng: np.random.Generator) -> Iterator[Question]:
    for i in case.found:
        color, _label, what = known[i]
        name = str(rng.choice(what.names))
        same = tuple(j for j, k in enumerate(known) if name in k[2].names)
        yield Question("name", f"give me the {name}", same)
        tinted = tuple(j for j in same if known[j][0] == color)
        if what.names[0] not in UNPAINTED and not what.color:
            yield Question("colour + name", f"the {color} {name}, please", tinted)
            shaped = tuple(j for j, k in enumerate(known) if k[0] == color and k[2].shape == what.shape)
            if what.shape and len(shaped) == sum(color in k[:2] for k in known):
                yield Question("colour + shape", f"pick up the {color} {what.shape} thing", shaped)
            near = (color, *NEAR_COLORS[color].split())
            if not any(c in near for j, k in enumerate(known) if j != i for c in k[:2]):
                yield Question("colour + unknown noun", f"grab the {color} gizmo", (i,))
        if what.category:
            members = tuple(j for j, k in enumerate(known) if k[2].category == what.category or _is_toy(k, what))
            yield Question("category", f"I need a {what.category}", members)
        if what.uses:
            use = str(rng.choice(what.uses))
            yield Question("use", f"something to {use}", tuple(j for j, k in enumerate(known) if use in k[2].uses))
        yield from _places(case, known, i, name, same)


def _is_toy(known: tuple[str, str, Truth], what: Truth) -> bool:
    """Whether a plain fruit may pass for a ball where a toy is asked for."""
    return what.category == "toy" and "ball" in known[2].names


def _places(case: Case, known: Known, i: int, name: str, same: tuple[int, ...]) -> Iterator[Question]:
    others = [j for j in same if j != i]
    for side, sign in (("left", -1), ("right", 1)):
        if others and np.nanmin([sign * (case.image[i, 0] - case.image[j, 0]) for j in others]) > 40:
            yield Question("left, right", f"the {name} on the {side}", (i,))
    where = np.array([thing.T_world_object[:2, 3] for thing in case.things])
    for near in case.found:
        label = known[near][2].names[0]
        if near == i or label == name or sum(label in k[2].names for k in known) > 1:
            continue
        gap = np.linalg.norm(where - where[near], axis=1)
        if others and gap[i] < 0.2 and gap[i] + 0.06 < min(gap[j] for j in others):
            yield Question("next to", f"the {name} next to the {label}", (i,))
        away = where[near] - case.eye[:2]
        away /= np.linalg.norm(away)
        ahead, aside = (where - where[near]) @ away, np.abs((where - where[near]) @ [-away[1], away[0]])
        behind = [j for j in range(len(known)) if j != near and ahead[j] > 0 and aside[j] < 1.5 * ahead[j]]
        if 0.06 < ahead[i] < 0.3 and aside[i] < 0.06:
            if behind == [i]:
                yield Question("behind", f"the thing behind the {label}", (i,))
            elif others and not set(behind) & set(others):
                yield Question("behind", f"the {name} behind the {label}", (i,))


def _superlatives(case: Case) -> Iterator[Question]:
    heights = np.array([height_m(thing) for thing in case.things])
    keys = {"leftmost": -case.image[:, 0], "rightmost": case.image[:, 0], "tallest": heights}
    margins = {"leftmost": 25.0, "rightmost": 25.0, "tallest": 0.02}
    for word, value in keys.items():
        order = [int(i) for i in np.argsort(-value) if np.isfinite(value[i])]
        if len(order) > 1 and order[0] in case.found and value[order[0]] - value[order[1]] > margins[word]:
            yield Question("superlative", f"the {word} object", (order[0],))


def _absent(case: Case, known: Known, rng: np.random.Generator) -> Iterator[Question]:
    taken = {word for *_, what in known for word in (*what.names, *what.like)}
    free = [noun for noun in ABSENT if noun not in taken]
    for noun in rng.choice(free, min(4, len(free)), replace=False):
        yield Question("absent noun", f"give me {'an' if noun[0] in 'aeio' else 'a'} {noun}", ())
    near = {n for k in known for c in k[:2] if c for n in (c, *NEAR_COLORS[c].split())}
    if any(what.names[0] in WITH_DARK_PARTS for *_, what in known):
        near.add("black")
    unseen = [c for c in COLORS if c not in near]
    for i in case.found:
        what = known[i][2]
        if not what.color and unseen and what.names[0] not in UNPAINTED:
            yield Question("absent colour", f"the {rng.choice(unseen)} {what.names[0]}", ())
            return


def answer(case: Case, question: Question) -> tuple[bool, str]:
    """Return whether the answer is right, and what was answered."""
    best = next(iter(ground(case.scene, parse(question.text)).fitting()), None)
    if best is None:
        return not question.answers, "nothing"
    column = [p.mark for p in case.scene.proposals].index(best.mark)
    thing = int(case.iou[:, column].argmax())
    right = any(case.iou[i, column] >= 0.5 for i in question.answers)
    return right, f"{case.things[thing].name} ({case.iou[thing, column]:.2f}) with {best.score:.2f}"


def main(scenes: int = 40, split: Literal["development", "test"] = "development", failures: bool = False) -> None:
    """Print how many answers are right, template by template."""
    right: Counter[str] = Counter()
    asked: Counter[str] = Counter()
    things = found = 0
    for i in range(scenes):
        seed = FIRST_SEED[split] + i
        case = make_case(VIEWS[i % len(VIEWS)], seed)
        things, found = things + len(case.things), found + len(case.found)
        for question in questions(case, np.random.default_rng(seed)):
            ok, said = answer(case, question)
            asked[question.template] += 1
            right[question.template] += ok
            if failures and not ok:
                truly = ", ".join(case.things[j].name for j in question.answers) or "absent"
                print(f"{seed:6d} {question.template:22s} {question.text:36s} {truly:28s} <- {said}")
    print(f"{split}: {scenes} scenes, {things} things, {found} found by perception")
    for name in asked:
        print(f"{name:22s} {right[name]:4d}/{asked[name]:<4d} {right[name] / asked[name]:5.2f}")
    there = [n for n in asked if not n.startswith("absent")]
    for name, group in (("all that is there", there), ("all that is absent", [n for n in asked if n not in there])):
        good, total = sum(right[n] for n in group), sum(asked[n] for n in group)
        print(f"{name:22s} {good:4d}/{total:<4d} {good / max(total, 1):5.2f}")


if __name__ == "__main__":
    tyro.cli(main)
