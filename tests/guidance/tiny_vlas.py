"""Tiny, randomly initialized multi_task_dit, pi0, pi05 and smolvla: LeRobot's own classes, no weights from the Hub.

LeRobot gives pi0 and pi05 no flags for their size, so the size tables of their modules are exchanged.
"""

import torch
from lerobot.policies import get_policy_class, make_pre_post_processors
from lerobot.processor import TokenizerProcessorStep
from tiny_policies import ACTIONS, WITH_CAMERA, make_config, statistics

from lerobot_agpd.guidance.adapters import as_teacher

SPECIAL = ["<unk>", "<eos>", "<fake>", "<global-img>", "<image>"]
WORDS = [*SPECIAL, "push", "lift", "the", "block", *map(str, range(256))]  # pi05 reads the state as numbers
LENGTH = 10  # tokens of an instruction
CHUNK = {"chunk_size": 6, "n_action_steps": 4, "max_state_dim": 4, "max_action_dim": 5}
LAYER = {"intermediate_size": 8, "num_hidden_layers": 1, "num_attention_heads": 2}
IMAGE = {"image_size": 16, "patch_size": 8, "hidden_size": 16, **LAYER}


def tokenizer(**special):
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    words = Tokenizer(models.WordLevel({word: i for i, word in enumerate(WORDS)}, unk_token="<unk>"))
    words.pre_tokenizer = pre_tokenizers.WhitespaceSplit()
    return PreTrainedTokenizerFast(
        tokenizer_object=words, pad_token="<eos>", eos_token="<eos>", unk_token="<unk>", **special
    )


def make_multi_task_dit(folder, **options):
    """Its text and vision encoders are read from a folder, whose name must contain "clip"."""
    from transformers import CLIPConfig, CLIPModel

    text = {
        "vocab_size": len(WORDS),
        "hidden_size": 8,
        "max_position_embeddings": LENGTH,
        "eos_token_id": 1,
        **LAYER,
    }
    path = str(folder / "clip")
    CLIPModel(CLIPConfig(text_config=text, vision_config=IMAGE, projection_dim=8)).save_pretrained(path)
    tokenizer().save_pretrained(path)
    config = make_config(
        "multi_task_dit",
        WITH_CAMERA,
        **{
            "horizon": 8,
            "n_action_steps": 4,
            "hidden_dim": 16,
            "num_layers": 1,
            "num_heads": 2,
            "timestep_embed_dim": 8,
            "tokenizer_max_length": LENGTH,
            "image_resize_shape": (16, 16),
            "image_crop_shape": None,
            "num_train_timesteps": 20,
            "num_integration_steps": 8,
            "vision_encoder_name": path,
            "text_encoder_name": path,
            **options,
        },
    )
    return finished(config)


def make_smolvla(folder, **options):
    """Its backbone is built from the configuration in a folder."""
    from transformers import (
        SmolVLMConfig,
        SmolVLMImageProcessor,
        SmolVLMProcessor,
        SmolVLMVideoProcessor,
    )

    text = {"model_type": "llama", "vocab_size": len(WORDS), "hidden_size": 16, "head_dim": 8, **LAYER}
    SmolVLMConfig(
        vision_config=IMAGE,
        text_config={**text, "num_key_value_heads": 1, "num_hidden_layers": 2},
        scale_factor=2,
        image_token_id=WORDS.index("<image>"),
    ).save_pretrained(folder)
    special = {
        "fake_image_token": "<fake>",
        "global_image_token": "<global-img>",
        "image_token": "<image>",
        "end_of_utterance_token": "<eos>",
    }
    SmolVLMProcessor(
        SmolVLMImageProcessor(), tokenizer(extra_special_tokens=special), SmolVLMVideoProcessor(), "-"
    ).save_pretrained(folder)
    sizes = {"num_vlm_layers": 2, "resize_imgs_with_padding": (16, 16), "num_steps": 8, **CHUNK}
    config = make_config(
        "smolvla",
        WITH_CAMERA,
        vlm_model_name=str(folder),
        tokenizer_max_length=LENGTH,
        **{**sizes, **options},
    )
    return finished(config)


def make_pi(policy_type, monkeypatch, **options):
    """pi0 or pi05; the tokenizer that LeRobot names is exchanged for a tiny one."""
    import importlib

    from transformers import GemmaConfig, PaliGemmaConfig

    module = importlib.import_module(f"lerobot.policies.{policy_type}.modeling_{policy_type}")
    processor = importlib.import_module(f"lerobot.policies.{policy_type}.processor_{policy_type}")
    sizes = {"width": 16, "depth": 1, "mlp_dim": 16, "num_heads": 2, "num_kv_heads": 1, "head_dim": 8}
    vision = {"model_type": "siglip_vision_model", **IMAGE, "patch_size": 14, "vision_use_head": False}
    paligemma = {"vision_config": vision, "text_config": {"model_type": "gemma"}}
    monkeypatch.setattr(module, "get_gemma_config", lambda variant: module.GemmaConfig(**sizes))
    monkeypatch.setattr(
        module, "CONFIG_MAPPING", {"paligemma": lambda: PaliGemmaConfig(**paligemma), "gemma": GemmaConfig}
    )
    monkeypatch.setattr(
        processor,
        "TokenizerProcessorStep",
        lambda tokenizer_name, **rest: TokenizerProcessorStep(tokenizer=tokenizer(), **rest),
    )
    config = make_config(
        policy_type,
        WITH_CAMERA,
        image_resolution=(28, 28),
        num_inference_steps=8,
        tokenizer_max_length=LENGTH,
        **{**CHUNK, **options},
    )

    def fit_projector(policy):  # whose width is hard-coded
        backbone = policy.model.paligemma_with_expert.paligemma.model
        backbone.multi_modal_projector.linear = torch.nn.Linear(IMAGE["hidden_size"], sizes["width"])

    return finished(config, fit_projector)


def finished(config, change=lambda policy: None):
    """The policy as a teacher, with weights large enough for everything it sees to matter."""
    torch.manual_seed(0)
    policy = get_policy_class(config.type)(config)
    change(policy)
    for parameter in policy.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    processors = make_pre_post_processors(config, dataset_stats=statistics({**WITH_CAMERA, **ACTIONS}))
    return as_teacher(policy, *processors)
