"""Windows, seams, relative positions and merging of the Swin transformer."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs thinkgrasp[langsam]")

from fakes.vlpart import golden  # noqa: E402

from thinkgrasp.networks import swin  # noqa: E402

CPU = torch.device("cpu")


def test_relative_positions_and_seams_are_the_originals():
    g = golden("golden_ops")
    np.testing.assert_array_equal(swin.relative_positions(7), g["swin/relative_position_index_w7"])
    np.testing.assert_array_equal(swin.shift_seams(9, 16, 7, 3), g["swin/attn_mask_9x16"])


def test_merging_is_the_originals():
    g = golden("golden_ops")
    merge = swin.PatchMerging(4)
    merge.load_state_dict({k: torch.from_numpy(g[f"swin/merge_{k}"]) for k in merge.state_dict()})
    with torch.no_grad():
        got = merge(torch.from_numpy(g["swin/merge_in_5x7"])[0], (5, 7))
    np.testing.assert_allclose(got, g["swin/merge_out"][0], atol=1e-5)


@pytest.mark.parametrize(("height", "width"), [(6, 9), (7, 14), (9, 16), (1, 1)])
@pytest.mark.parametrize("shift", [0, 3])
def test_windows_are_pad_roll_and_cut(height, width, shift):
    at = swin.windows(height, width, 7, shift, CPU)
    tall, wide = -(-height // 7) * 7, -(-width // 7) * 7
    grid = torch.zeros(tall, wide)
    grid[:height, :width] = torch.arange(1, height * width + 1).view(height, width)
    rolled = torch.roll(grid, (-shift, -shift), (0, 1)).view(tall // 7, 7, wide // 7, 7).transpose(1, 2).reshape(-1, 49)
    cut = torch.where(at.padding, 0, at.tokens.view(-1, 49) + 1)
    assert torch.equal(cut, rolled.long())
    assert torch.equal(at.tokens[at.places], torch.arange(height * width))
    assert (at.seams is None) == (shift == 0)


def reference(block: swin.SwinBlock, tokens: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """A block as it is written down: pad after the norm, roll, window by window, whole softmax."""
    height, width = size
    attn, n, heads = block.attn, 49, block.attn.heads
    normed = block.norm1(tokens).view(height, width, -1)
    c = normed.shape[2]
    tall, wide = -(-height // 7) * 7, -(-width // 7) * 7
    grid = torch.zeros(tall, wide, c)
    grid[:height, :width] = normed
    grid = torch.roll(grid, (-block.shift, -block.shift), (0, 1))
    seams = swin.shift_seams(height, width, 7, block.shift) if block.shift else torch.zeros(tall * wide // n, n, n)
    bias = attn.relative_position_bias_table[swin.relative_positions(7).view(-1)].view(n, n, heads).permute(2, 0, 1)
    out = torch.zeros_like(grid)
    for w, (i, j) in enumerate((i, j) for i in range(0, tall, 7) for j in range(0, wide, 7)):
        q, k, v = attn.qkv(grid[i : i + 7, j : j + 7].reshape(n, c)).view(n, 3, heads, -1).permute(1, 2, 0, 3)
        logits = q * q.shape[-1] ** -0.5 @ k.transpose(1, 2) + bias + seams[w]
        mixed = (logits.softmax(-1) @ v).transpose(0, 1).reshape(n, c)
        out[i : i + 7, j : j + 7] = attn.proj(mixed).view(7, 7, c)
    out = torch.roll(out, (block.shift, block.shift), (0, 1))[:height, :width].reshape(-1, c)
    tokens = tokens + out
    return tokens + block.mlp(block.norm2(tokens))


@pytest.mark.parametrize("shift", [0, 3])
@pytest.mark.parametrize("size", [(6, 9), (14, 7), (16, 20)])
def test_a_block_is_what_is_written_down(size, shift, monkeypatch):
    torch.manual_seed(0)
    block = swin.SwinBlock(8, 2, 7, shift, 4)
    with torch.no_grad():
        for parameter in block.parameters():
            parameter.copy_(torch.randn(parameter.shape))
        tokens = torch.randn(size[0] * size[1], 8)
        wanted = reference(block, tokens, size)
        torch.testing.assert_close(block(tokens.clone(), size), wanted, atol=1e-4, rtol=1e-4)
        monkeypatch.setattr(swin, "TOKENS_AT_A_TIME", 50)
        torch.testing.assert_close(block(tokens.clone(), size), wanted, atol=1e-4, rtol=1e-4)
