"""ACT-DP: ACT's own encoder conditions the denoiser, and the policy teaches like any diffusion policy."""

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.policies.act.modeling_act import ACT

from lerobot_agpd.config import TeacherConfig
from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.guidance.discrepancy import ActionDiscrepancy
from lerobot_agpd.guidance.guide import Guide
from lerobot_agpd.loading import load_teacher
from lerobot_agpd.policies.act_diffusion.configuration_act_diffusion import ACTDiffusionConfig
from lerobot_agpd.policies.act_diffusion.modeling_act_diffusion import ACTDiffusionPolicy
from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    TransformerDenoiserConfig,
)

B, H = 3, 8
SMALL = {
    "horizon": H,
    "n_action_steps": 4,
    "num_train_timesteps": 10,
    "dim_model": 16,
    "n_heads": 2,
    "dim_feedforward": 32,
    "n_encoder_layers": 1,
    "pretrained_backbone_weights": None,
    "device": "cpu",
    "push_to_hub": False,
}
HEAD = {"width": 16, "n_layers": 1, "n_heads": 2, "attention_dropout": 0.0, "causal": False}
CAMERAS = {
    "observation.images.top": PolicyFeature(FeatureType.VISUAL, (3, 70, 40)),
    "observation.images.wrist": PolicyFeature(FeatureType.VISUAL, (3, 70, 40)),
}


@pytest.fixture
def make_config(input_features, output_features):
    def build(images=False, **options) -> ACTDiffusionConfig:
        inputs = {**input_features, **(CAMERAS if images else {})}
        features = {"input_features": inputs, "output_features": dict(output_features)}
        head = {"transformer": TransformerDenoiserConfig(**HEAD)}
        return ACTDiffusionConfig(**{**SMALL, **features, **head, "in_memory": not images, **options})

    return build


def batch_for(config, actions=True, n=B) -> dict:
    batch = {key: torch.rand(n, 1, *ft.shape) for key, ft in config.input_features.items()}
    if actions:
        batch |= {"action": torch.randn(n, H, 2), "action_is_pad": torch.zeros(n, H, dtype=torch.bool)}
    return batch


@pytest.mark.parametrize("options", [{"causal": True}, {"causal": False}])
def test_every_action_attends_to_every_token(make_config, options):
    config = make_config(transformer=TransformerDenoiserConfig(**{**HEAD, **options}))
    net = ACTDiffusionPolicy(config).double().eval().diffusion.unet
    x, condition = torch.randn(1, H, 2).double(), torch.randn(1, 3 * 16).double()
    for token in range(3):
        moved = condition.clone()
        moved[:, 16 * token] += 1
        difference = (net(x, 3, moved) - net(x, 3, condition)).abs().amax(dim=(0, 2))
        assert bool((difference > 1e-13).all())


def test_the_condition_is_what_acts_decoder_would_attend_to(make_config):
    """LeRobot's ACT with the same weights: keys of its cross-attention are encoder tokens plus positions."""
    policy = ACTDiffusionPolicy(make_config(images=True)).eval()
    config = policy.config.act_config()
    config.n_decoder_layers = 1
    act = ACT(config).eval()
    act.load_state_dict(policy.diffusion.act.state_dict(), strict=False)
    keys = []
    act.decoder.layers[0].multihead_attn.register_forward_pre_hook(
        lambda module, args, kwargs: keys.append(kwargs["key"]), with_kwargs=True
    )
    batch = batch_for(policy.config, actions=False)
    act(
        {
            "observation.state": batch["observation.state"][:, 0],
            "observation.environment_state": batch["observation.environment_state"][:, 0],
            "observation.images": [batch[key][:, 0] for key in CAMERAS],
        }
    )
    batch["observation.images"] = torch.stack([batch[key] for key in CAMERAS], dim=-4)
    condition = policy.diffusion._prepare_global_conditioning(batch)
    assert torch.equal(condition.unflatten(1, (-1, 16)), keys[0].transpose(0, 1))


@pytest.mark.parametrize(
    ("options", "n_tokens"),
    [
        ({}, 3),
        ({"images": True}, 3 + 2 * 3 * 2),
        ({"images": True, "vision_backbone": "resnet50"}, 3 + 2 * 3 * 2),
    ],
)
def test_number_of_tokens(make_config, options, n_tokens):
    """Latent, state, environment state, and per camera of 70 x 40 pixels a map of 3 x 2 cells."""
    config = make_config(**options)
    assert config.n_encoder_tokens == n_tokens
    policy = ACTDiffusionPolicy(config).train()
    loss, _ = policy.forward(batch_for(config))
    loss.backward()
    untrained = [n for n, p in policy.named_parameters() if p.requires_grad and p.grad is None]
    assert untrained == []


def test_no_second_image_encoder(make_config):
    names = [name for name, _ in ACTDiffusionPolicy(make_config(images=True)).named_children()]
    model = ACTDiffusionPolicy(make_config(images=True)).diffusion
    assert names == ["diffusion"]
    assert {name for name, _ in model.named_children()} == {"act", "unet"}


def test_one_encoding_serves_all_noise_levels(make_config):
    policy = ACTDiffusionPolicy(make_config(noise_samples_per_frame=4)).train()
    encoded, denoised = [], []
    policy.diffusion.act.encoder.register_forward_hook(lambda m, a, out: encoded.append(out.shape[1]))
    policy.diffusion.unet.register_forward_pre_hook(lambda m, args: denoised.append(len(args[0])))
    policy.forward(batch_for(policy.config))
    assert (encoded, denoised) == ([B], [4 * B])


def test_weight_decay_spares_norms_embeddings_and_convolutions(make_config):
    policy = ACTDiffusionPolicy(make_config(images=True))
    decaying, others = policy.get_optim_params()
    names = {id(parameter): name for name, parameter in policy.named_parameters()}
    decayed = {names[id(p)] for p in decaying["params"]}
    spared = {names[id(p)] for p in others["params"]}
    assert "diffusion.act.encoder.layers.0.self_attn.in_proj_weight" in decayed
    assert "diffusion.act.encoder_1d_feature_pos_embed.weight" in spared
    assert "diffusion.act.backbone.conv1.weight" in spared and "diffusion.unet.action_positions" in spared
    assert set(names.values()) - decayed - spared == {"diffusion.act.decoder_pos_embed.weight"}


def test_it_learns_chunks_by_heart(make_config):
    """Three observations with a chunk each: sampled chunks are theirs, not their mean."""
    sampler = {"noise_scheduler_type": "DDIM", "num_inference_steps": 5, "prediction_type": "sample"}
    policy = ACTDiffusionPolicy(make_config(dropout=0.0, pre_norm=True, **sampler)).train()
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=3e-3, weight_decay=0.0)
    batch = batch_for(policy.config)
    batch["action"] = (2 * torch.rand(B, 1, 2) - 1).expand(B, H, 2)
    for _ in range(120):
        optimizer.zero_grad()
        policy.forward(batch)[0].backward()
        optimizer.step()
        policy.update()
    policy.eval()
    with torch.no_grad():
        chunk = policy.diffusion.generate_actions(batch)
    expected = batch["action"][:, :4]
    assert (expected - expected.mean(0)).abs().mean() > 0.25
    assert (chunk - expected).abs().mean() < 0.1


@pytest.mark.parametrize("at", ["x0", "mu"])
def test_it_teaches(make_config, demonstrations, tmp_path, at):
    """Loaded as any teacher; a guide pulls its chunk to the target, scale 0 leaves it as it is."""
    policy = ACTDiffusionPolicy(make_config(prediction_type="epsilon"))
    policy.save_pretrained(tmp_path)
    for processor in make_pre_post_processors(policy.config, dataset_stats=demonstrations.meta.stats):
        processor.save_pretrained(tmp_path)
    teacher = load_teacher(TeacherConfig(path=str(tmp_path), num_inference_steps=10), "cpu")
    assert (teacher.n_obs_steps, teacher.start, teacher.n_chunk_steps) == (1, 0, H)

    history = batch_for(policy.config, actions=False)
    target = torch.full((B, H, 2), 0.5)  # in the teacher's normalized space
    chunks = {}
    for scale in (None, 0.0, 50.0):
        guide = None
        if scale is not None:
            guide = Guide(ActionDiscrepancy(target, teacher.start), torch.full((B,), scale), at=at)
        torch.manual_seed(5)
        chunks[scale] = teacher.normalize(teacher.sample(history, guide))
    assert chunks[None].shape == (B, H, 2)
    assert torch.equal(chunks[None], chunks[0.0])
    distance = {scale: (chunk - target).square().mean() for scale, chunk in chunks.items()}
    assert distance[50.0] < 0.5 * distance[None]


def test_config_round_trip(make_config, tmp_path):
    config = make_config(images=True)
    config.save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path) == config


@pytest.mark.parametrize(
    ("options", "flag"),
    [
        ({"denoiser": "mlp"}, "--policy.denoiser must be 'transformer'"),
        ({"n_obs_steps": 2}, "--policy.n_obs_steps"),
        ({"crop_shape": (32, 32)}, "--policy.crop_shape"),
        ({"use_group_norm": True}, "--policy.use_group_norm"),
        ({"dim_model": 18}, "--policy.dim_model"),
        ({"n_encoder_layers": 0}, "--policy.n_encoder_layers"),
    ],
)
def test_wrong_flags_are_named(make_config, options, flag):
    with pytest.raises(FlagError, match=flag):
        make_config(**options)
