"""Models of the right structure with random weights, saved as `from_pretrained` reads them.

Tests run small ones; `benchmarks/segmenters.py` runs those of the published sizes. What they find means nothing.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

_SPECIAL = {0: "[PAD]", 100: "[UNK]", 101: "[CLS]", 102: "[SEP]", 103: "[MASK]", 1012: ".", 1029: "?"}
"""Where BERT has them: GroundingDINO knows the ends of phrases by these numbers."""
_LETTERS = "abcdefghijklmnopqrstuvwxyz0123456789"
FULL_SPREAD = 0.5
"""Keeps the size of what passes through. The library's own spread lets it vanish, and such numbers are slow on CPUs."""


def save_grounding_dino(folder: Path, *, small: bool = True, seed: int = 0) -> Path:
    """Save a GroundingDINO: a small one, or one with the sizes of grounding-dino-tiny."""
    from transformers import BertConfig, GroundingDinoConfig, GroundingDinoForObjectDetection

    if small:
        swin = {
            "model_type": "swin",
            "embed_dim": 16,
            "depths": [1, 1, 1, 1],
            "num_heads": [1, 2, 2, 4],
            "window_size": 4,
            "image_size": 64,
            "out_indices": [2, 3, 4],
        }
        bert = BertConfig(
            vocab_size=1200,
            hidden_size=32,
            num_hidden_layers=1,
            num_attention_heads=2,
            intermediate_size=64,
            max_position_embeddings=64,
        )
        config = GroundingDinoConfig(
            backbone_config=swin,
            text_config=bert,
            d_model=32,
            encoder_layers=1,
            decoder_layers=2,
            encoder_attention_heads=4,
            decoder_attention_heads=4,
            encoder_ffn_dim=64,
            decoder_ffn_dim=64,
            num_queries=30,
            max_text_len=48,
        )
    else:
        config = GroundingDinoConfig()
    size = {"shortest_edge": 96, "longest_edge": 160} if small else {"shortest_edge": 800, "longest_edge": 1333}
    _save(GroundingDinoForObjectDetection, config, folder, seed, 0.4 if small else FULL_SPREAD)
    _save_input(folder, {"size": size, "image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]})
    _save_bert_tokenizer(folder, 1200 if small else 30522)
    return folder


def save_sam(folder: Path, *, small: bool = True, seed: int = 0) -> Path:
    """Save a SAM: a small one, or one with the sizes of sam-vit-base."""
    from transformers import SamConfig, SamMaskDecoderConfig, SamModel, SamPromptEncoderConfig, SamVisionConfig

    side = 128 if small else 1024
    if small:
        config = SamConfig(
            vision_config=SamVisionConfig(
                hidden_size=32,
                num_hidden_layers=2,
                num_attention_heads=2,
                image_size=side,
                output_channels=32,
                num_pos_feats=16,
                mlp_dim=64,
                window_size=4,
                global_attn_indexes=[1],
            ),
            prompt_encoder_config=SamPromptEncoderConfig(hidden_size=32, image_size=side),
            mask_decoder_config=SamMaskDecoderConfig(
                hidden_size=32, mlp_dim=64, num_attention_heads=2, iou_head_hidden_dim=32
            ),
        )
    else:
        config = SamConfig()
    _save(SamModel, config, folder, seed, 0.3 if small else FULL_SPREAD)
    _save_input(folder, {"size": {"longest_edge": side}, "pad_size": {"height": side, "width": side}})
    return folder


def save_sam2(folder: Path, *, small: bool = True, seed: int = 0) -> Path:
    """Save a SAM 2: a small one, or one with the sizes of sam2.1-hiera-small."""
    from transformers import (
        Sam2Config,
        Sam2HieraDetConfig,
        Sam2MaskDecoderConfig,
        Sam2Model,
        Sam2PromptEncoderConfig,
        Sam2VisionConfig,
    )

    side = 128 if small else 1024
    if small:
        hiera = Sam2HieraDetConfig(
            hidden_size=16,
            image_size=[side, side],
            blocks_per_stage=[1, 1, 2, 1],
            embed_dim_per_stage=[16, 32, 64, 128],
            num_attention_heads_per_stage=[1, 2, 2, 4],
            window_size_per_stage=[8, 4, 8, 4],
            global_attention_blocks=[3],
        )
        config = Sam2Config(
            vision_config=Sam2VisionConfig(
                backbone_config=hiera,
                backbone_channel_list=[128, 64, 32, 16],
                backbone_feature_sizes=[[32, 32], [16, 16], [8, 8]],
                fpn_hidden_size=32,
            ),
            prompt_encoder_config=Sam2PromptEncoderConfig(hidden_size=32, image_size=side),
            mask_decoder_config=Sam2MaskDecoderConfig(
                hidden_size=32, mlp_dim=64, num_attention_heads=2, iou_head_hidden_dim=32
            ),
        )
    else:
        hiera = Sam2HieraDetConfig(blocks_per_stage=[1, 2, 11, 2], global_attention_blocks=[7, 10, 13])
        config = Sam2Config(vision_config=Sam2VisionConfig(backbone_config=hiera))
    _save(Sam2Model, config, folder, seed, 0.3 if small else FULL_SPREAD)
    _save_input(folder, {"size": {"height": side, "width": side}})
    return folder


def save_sam3(folder: Path, *, small: bool = True, seed: int = 0) -> Path:
    """Save a SAM 3: a small one, or one of the published size."""
    from transformers import CLIPTextConfig, Sam3Config, Sam3Model

    side = 112 if small else 1008
    if small:
        part = {"hidden_size": 32, "num_attention_heads": 2, "intermediate_size": 64, "num_layers": 1}
        config = Sam3Config(
            vision_config={
                "backbone_config": {
                    "model_type": "sam3_vit_model",
                    "hidden_size": 32,
                    "intermediate_size": 64,
                    "num_hidden_layers": 2,
                    "num_attention_heads": 2,
                    "image_size": side,
                    "pretrain_image_size": 56,
                    "window_size": 4,
                    "global_attn_indexes": [1],
                },
                "fpn_hidden_size": 32,
                "backbone_feature_sizes": [[32, 32], [16, 16], [8, 8]],
            },
            text_config=CLIPTextConfig(
                vocab_size=600,
                hidden_size=32,
                intermediate_size=64,
                projection_dim=16,
                num_hidden_layers=1,
                num_attention_heads=2,
                max_position_embeddings=32,
                bos_token_id=0,
                eos_token_id=1,
            ).to_dict(),
            geometry_encoder_config=part,
            detr_encoder_config=part,
            detr_decoder_config={**part, "num_queries": 12},
            mask_decoder_config={"hidden_size": 32, "num_attention_heads": 2},
        )
    else:
        config = Sam3Config()
    _save(Sam3Model, config, folder, seed, 0.4 if small else FULL_SPREAD)
    _save_input(folder, {"size": {"height": side, "width": side}, "image_mean": [0.5] * 3, "image_std": [0.5] * 3})
    _save_clip_tokenizer(folder, 600 if small else 49408)
    return folder


def _save(cls: Any, config: Any, folder: Path, seed: int, spread: float) -> None:
    """Save a model with random weights; `spread` draws all matrices anew, wide enough for outputs to differ."""
    import torch

    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(seed)
        model = cls(config)
        for parameter in model.parameters():
            if parameter.dim() > 1:
                fan_in = parameter[0].numel()
                parameter.normal_(std=spread * max(fan_in, 1) ** -0.5 * 2)
            elif parameter.dim() == 1 and bool((parameter == 0).all()):
                parameter.normal_(std=0.1)
        model.save_pretrained(folder)


def _save_input(folder: Path, settings: dict[str, Any]) -> None:
    (folder / "preprocessor_config.json").write_text(json.dumps(settings), encoding="utf-8")


def _save_bert_tokenizer(folder: Path, size: int) -> None:
    """Save a tokenizer that spells words letter by letter, with BERT's special tokens at BERT's numbers."""
    from transformers import BertTokenizer

    pieces = iter([*_LETTERS, *(f"##{letter}" for letter in _LETTERS), *"!,-'"])
    tokens = [_SPECIAL.get(i) or next(pieces, f"[unused{i}]") for i in range(size)]
    BertTokenizer(vocab={token: i for i, token in enumerate(tokens)}).save_pretrained(folder)


def _save_clip_tokenizer(folder: Path, size: int) -> None:
    """Save a tokenizer that spells words letter by letter."""
    from transformers import CLIPTokenizer

    pieces = ["<|startoftext|>", "<|endoftext|>", *_LETTERS, *(f"{letter}</w>" for letter in _LETTERS)]
    pieces += [f"<|unused{i}|>" for i in range(size - len(pieces))]
    CLIPTokenizer(vocab={piece: i for i, piece in enumerate(pieces)}, merges=[]).save_pretrained(folder)
