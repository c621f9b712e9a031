"""Everything that VLPart computes for one image and one text matrix, by name: for holding it against a reference."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from thinkgrasp.networks import boxes as bx
from thinkgrasp.networks.cascade_head import BOX_WEIGHTS
from thinkgrasp.networks.vlpart import Regions, VLPart, prepare, select_detections, to_original


@torch.no_grad()
def trace(model: VLPart, rgb: NDArray[np.uint8], text: Tensor) -> dict[str, Tensor]:
    """Run the network and return every step of it.

    Args:
        model: The network; its config's selection decides the variant.
        rgb: (H, W, 3) uint8.
        text: (text_width, C + 1), as `text_matrix` makes it.

    Returns:
        By name, on the CPU (sizes without the batch axis):
            input (3, H, W); patch_embed (H / 4 * W / 4, C); swin/block{s}_{b} (L, C); swin/out{s} and fpn/p{2..6}
            (C, H, W);
            rpn/logits_p{2..6} (3, H, W); rpn/deltas_p{2..6} (12, H, W); proposals (N, 4); proposal_logits (N,);
            s{0..2}/boxes_in (N, 4), s{k}/levels (N,) 0 = p2, s{k}/pooled (N, C, 7, 7), s{k}/head (N, width),
            s{k}/cls_logits (N, C + 1), s{k}/deltas (N, 4); final_boxes_unclipped (N, 4) and final_scores_with_bg
            (N, C + 1);
            nms_all_scores, nms_all_classes, nms_all_rows (M,): all that are left without overlaps, not only the best;
            det_boxes (D, 4), det_scores, det_classes, det_rows (D,): the best, in the network's image;
            out_boxes (D, 4), out_scores, out_classes (D,): in the original image.
    """
    steps: dict[str, Tensor] = {}
    with ExitStack() as hooks:

        def keep(module: nn.Module, store: Callable[[nn.Module, object, object], None]) -> None:
            hooks.callback(module.register_forward_hook(store).remove)

        swin = model.backbone.bottom_up
        keep(swin.patch_embed, lambda m, i, o: steps.update(patch_embed=o[0].clone()))  # pyright: ignore
        for s, stage in enumerate(swin.layers):  # pyright: ignore
            for b, block in enumerate(stage.blocks):
                keep(block, lambda m, i, o, name=f"swin/block{s}_{b}": steps.update({name: o.clone()}))  # pyright: ignore
        keep(swin, lambda m, i, o: steps.update({f"swin/out{s}": x[0] for s, x in enumerate(o)}))  # pyright: ignore
        levels: list[tuple[Tensor, Tensor]] = []
        keep(model.proposal_generator["rpn_head"], lambda m, i, o: levels.append(o))  # pyright: ignore

        image = prepare(rgb, model.config)
        maps = model.pyramid(image)
        proposals = model.propose(maps, image.size_hw)
    steps["input"] = image.pixels[0]
    for i, (level, (logits, deltas)) in enumerate(zip(maps, levels, strict=True), start=2):
        steps |= {f"fpn/p{i}": level[0], f"rpn/logits_p{i}": logits[0], f"rpn/deltas_p{i}": deltas[0]}
    steps |= {"proposals": proposals.boxes, "proposal_logits": proposals.logits}

    moved, queries = proposals.boxes, []
    for k in range(len(BOX_WEIGHTS)):
        stage = model.roi_heads.stage(k, maps[:-1], bx.clip(moved, image.size_hw))
        steps |= {f"s{k}/boxes_in": stage.boxes_in, f"s{k}/levels": stage.levels - 2, f"s{k}/pooled": stage.pooled}
        steps |= {f"s{k}/head": stage.described, f"s{k}/deltas": stage.deltas}
        steps[f"s{k}/cls_logits"] = stage.queries @ text.to(stage.queries)
        queries.append(stage.queries)
        moved = stage.boxes_out
    regions = Regions(moved, torch.stack(queries), proposals.logits, image.size_hw, image.original_hw)
    scores = model.scores(regions, text)
    steps |= {"final_boxes_unclipped": regions.boxes, "final_scores_with_bg": scores}

    selection = model.config.selection
    for prefix, limit in (("nms_all", scores.numel()), ("det", selection.detections)):
        found = select_detections(regions.boxes, scores, image.size_hw, replace(selection, detections=limit))
        steps |= {f"{prefix}_{name}": value for name, value in found._asdict().items()}
    original = to_original(found, image.size_hw, image.original_hw)
    steps |= {f"out_{name}": value for name, value in original._asdict().items()}
    return {name: value.float().cpu() if value.is_floating_point() else value.cpu() for name, value in steps.items()}
