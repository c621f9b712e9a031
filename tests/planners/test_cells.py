"""Where a thing is taken, on outlines drawn by hand."""

from __future__ import annotations

import numpy as np
import pytest
from fakes.household import HEIGHT, WIDTH, scene, thing

from thinkgrasp.planners.cells import Outline, choose_cell, part_region, rim_region
from thinkgrasp.types import Mask, Proposal


def drawn(mask: Mask, shapes: dict[str, float] | None = None) -> Proposal:
    return thing(1, (0, 0), (0.1, 0.1, 0.1), {"red": 1.0}, shapes or {}, mask=mask)


def canvas() -> Mask:
    return np.zeros((HEIGHT, WIDTH), bool)


def outline_of(proposal: Proposal) -> Outline:
    return Outline.of(scene([proposal]), proposal)


def center(outline: Outline, region: Mask | None) -> tuple[float, float]:
    assert region is not None
    v, u = np.nonzero(region)
    return float(outline.u[u].mean()), float(outline.v[v].mean())


def test_an_outline_is_thinned_out_to_a_bounded_size() -> None:
    mask = canvas()
    mask[10:470, 10:630] = True
    outline = outline_of(drawn(mask))
    assert max(outline.mask.shape) <= 96 + 1
    assert outline.mask.mean() > 0.5


def test_a_compact_thing_is_taken_in_the_middle() -> None:
    mask = canvas()
    mask[200:260, 300:360] = True
    assert choose_cell(outline_of(drawn(mask)), drawn(mask), 3).cell == 5


def test_the_middle_of_an_l_shape_is_not_an_empty_cell() -> None:
    mask = canvas()
    mask[200:290, 300:325] = True
    mask[265:290, 300:390] = True
    choice = choose_cell(outline_of(drawn(mask)), drawn(mask), 3)
    assert choice.cell in (1, 4, 7, 8, 9)
    assert choice.score > 0


def test_failed_cells_are_avoided() -> None:
    mask = canvas()
    mask[200:260, 300:360] = True
    tried: list[int] = []
    for _ in range(4):
        tried.append(choose_cell(outline_of(drawn(mask)), drawn(mask), 3, failed=tried).cell)
    assert len(set(tried)) == 4


def test_a_part_to_avoid_is_avoided() -> None:
    mask = canvas()
    mask[220:240, 250:390] = True
    proposal = drawn(mask)
    outline = outline_of(proposal)
    middle_and_left = outline.mask & (outline.u < 340)[None, :]
    assert choose_cell(outline, proposal, 3, avoid=middle_and_left).cell % 3 == 0


@pytest.mark.parametrize("angle_deg", [0, 30, 90, 135])
def test_the_wide_end_is_found_at_any_angle(angle_deg: float) -> None:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    along, across = (u - 320) * c + (v - 240) * s, -(u - 320) * s + (v - 240) * c
    mask = (abs(along) < 80) & (abs(across) < np.where(along > 30, 18, 6))
    outline = outline_of(drawn(mask))
    wide = center(outline, part_region(outline, "wide"))
    thin = center(outline, part_region(outline, "thin"))
    assert (wide[0] - 320) * c + (wide[1] - 240) * s > 30
    assert (thin[0] - 320) * c + (thin[1] - 240) * s < -30


def test_ends_that_look_alike_are_not_told_apart() -> None:
    mask = canvas()
    mask[230:250, 250:390] = True
    outline = outline_of(drawn(mask))
    assert part_region(outline, "wide") is None
    assert part_region(outline, "middle") is not None


def test_a_disc_has_no_protrusion_and_a_handle_is_one() -> None:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    disc = np.hypot(u - 320, v - 240) < 45
    assert part_region(outline_of(drawn(disc)), "protrusion") is None
    panhandled = disc | ((abs(v - 240) < 8) & (u > 320) & (u < 440))
    outline = outline_of(drawn(panhandled))
    assert center(outline, part_region(outline, "protrusion"))[0] > 370


def test_the_rim_is_the_outer_band_where_heights_are_unknown() -> None:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    proposal = drawn(np.hypot(u - 320, v - 240) < 45)
    outline = outline_of(proposal)
    flat = Outline(
        outline.mask, outline.others, np.full(outline.mask.shape, np.nan), outline.u, outline.v, outline.metres_per_px
    )
    rim = rim_region(flat)
    dv, du = np.nonzero(rim)
    assert np.hypot(flat.u[du] - 320, flat.v[dv] - 240).min() > 25
    assert part_region(flat, "top") is None


def test_a_hollow_thing_is_not_taken_in_its_empty_middle() -> None:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    proposal = drawn(np.hypot(u - 320, v - 240) < 45, {"round": 0.9, "hollow": 0.9})
    outline = outline_of(proposal)
    radius = np.hypot(outline.u[None, :] - 320, outline.v[:, None] - 240)
    height = np.where(radius > 33, 0.08, 0.01)
    bowl = Outline(outline.mask, outline.others, height, outline.u, outline.v, outline.metres_per_px)
    assert choose_cell(bowl, proposal, 3).cell != 5
