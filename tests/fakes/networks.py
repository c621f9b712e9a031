"""Files of weights of networks that have learnt nothing: right names and shapes, meaningless answers."""

from __future__ import annotations

from pathlib import Path


def untrained_vgn(folder: Path) -> Path:
    import torch

    from thinkgrasp.networks.vgn import Vgn

    torch.manual_seed(0)
    path = folder / "untrained_vgn.pth"
    torch.save(Vgn().state_dict(), path)
    return path
