"""What LeRobot demands of a policy type, checked for every type of this plugin, with and without images."""

import inspect
from copy import deepcopy
from pathlib import Path
from types import SimpleNamespace

import draccus
import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.optim.factory import make_optimizer_and_scheduler
from lerobot.policies import PreTrainedPolicy, get_policy_class, make_policy, make_pre_post_processors
from lerobot.policies.factory import make_policy_config
from lerobot.utils.import_utils import register_third_party_plugins
from safetensors.torch import load_file
from torch.utils.data import default_collate

from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    MLPDenoiserConfig,
    TransformerDenoiserConfig,
)

register_third_party_plugins()

TRANSFORMER = {"dim_model": 32, "n_heads": 2, "dim_feedforward": 64, "n_encoder_layers": 1}
ACT = {**TRANSFORMER, "chunk_size": 8, "n_action_steps": 4, "n_vae_encoder_layers": 1}
SAMPLER = {"horizon": 8, "n_action_steps": 4, "num_inference_steps": 2}
HEAD = {"transformer": TransformerDenoiserConfig(width=16, n_layers=1, n_heads=2)}
MLP = {**SAMPLER, "denoiser": "mlp", "mlp": MLPDenoiserConfig(width=16, n_blocks=1)}
UNET = {**SAMPLER, "denoiser": "unet", "down_dims": (16,)}
FROM_LOADER = {"in_memory": False}

# name: (policy type, sizes, what images need)
CASES = {
    "agpd": ("agpd", ACT, {}),
    "dp-mlp": ("diffusion_transformer", MLP, FROM_LOADER),
    "dp-t": ("diffusion_transformer", {**SAMPLER, **HEAD, "denoiser": "transformer"}, FROM_LOADER),
    "dp-c": ("diffusion_transformer", UNET, FROM_LOADER),
    "agpd-dp": ("agpd_diffusion", MLP, {}),
    "act-dp": ("act_diffusion", {**SAMPLER, **HEAD, **TRANSFORMER}, FROM_LOADER),
}
TYPES = sorted({policy_type for policy_type, _, _ in CASES.values()})

PRESETS = sorted((Path(__file__).parents[2] / "examples" / "presets").glob("*.yaml"))

STATE = {"dtype": "float32", "shape": (2,), "names": None}
IMAGE = {"dtype": "image", "shape": (64, 64, 3), "names": ["height", "width", "channels"]}


@pytest.fixture(scope="session")
def filmed(tmp_path_factory) -> LeRobotDataset:
    """One episode of 8 frames with a state and a camera."""
    features = {"observation.state": STATE, "observation.images.top": IMAGE, "action": STATE}
    root = tmp_path_factory.mktemp("data") / "filmed"
    dataset = LeRobotDataset.create(
        "local/filmed", fps=10, features=features, root=root, robot_type="none", use_videos=False
    )
    rng = np.random.default_rng(0)
    for _ in range(8):
        frame = {key: rng.normal(size=2).astype(np.float32) for key in ("observation.state", "action")}
        frame["observation.images.top"] = rng.integers(0, 255, (64, 64, 3), dtype=np.uint8)
        dataset.add_frame({**frame, "task": "a small task"})
    dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset("local/filmed", root=root)


@pytest.fixture(params=["vectors", "images"])
def dataset(request, demonstrations, filmed) -> LeRobotDataset:
    return filmed if request.param == "images" else demonstrations


def make_config(case, **options) -> PreTrainedConfig:
    policy_type, sizes, _ = CASES[case]
    config = make_policy_config(policy_type, push_to_hub=False, device="cpu", **deepcopy(sizes), **options)
    if hasattr(config, "adversary"):  # the checks train without a teacher
        config.collect.every = 0
        config.adversary.weight = 0
    return config


@pytest.fixture(params=CASES)
def config(request, dataset) -> PreTrainedConfig:
    _, _, for_images = CASES[request.param]
    options = {**for_images, "pretrained_backbone_weights": None} if dataset.meta.camera_keys else {}
    return make_config(request.param, **options)


@pytest.fixture
def policy(config, dataset) -> PreTrainedPolicy:
    return make_policy(config, ds_meta=dataset.meta)


@pytest.fixture
def batch(config, policy, dataset) -> dict:
    """Three items as the loader delivers them to this policy, not normalized."""
    deltas = resolve_delta_timestamps(config, dataset.meta)
    items = LeRobotDataset(dataset.repo_id, root=dataset.root, delta_timestamps=deltas)
    return default_collate([items[0], items[4], items[7]])


def series(*shape) -> torch.Tensor:
    """Evenly spaced numbers from -1 to 1."""
    return torch.linspace(-1, 1, int(np.prod(shape))).view(shape)


def observation(config) -> dict[str, torch.Tensor]:
    return {key: torch.rand(2, *feature.shape) for key, feature in config.input_features.items()}


@pytest.mark.parametrize("policy_type", TYPES)
def test_classes_are_found_by_name(policy_type):
    policy_class = get_policy_class(policy_type)
    assert policy_class.name == policy_type
    assert policy_class.config_class is PreTrainedConfig.get_choice_class(policy_type)
    parameter = inspect.signature(policy_class.__init__).parameters["config"]
    assert parameter.annotation is policy_class.config_class


@pytest.mark.parametrize("policy_type", TYPES)
def test_defaults_build_without_teacher_or_dataset(policy_type, input_features, output_features):
    config = make_policy_config(policy_type, push_to_hub=False, device="cpu")
    config.input_features, config.output_features = dict(input_features), dict(output_features)
    get_policy_class(policy_type)(config)


@pytest.mark.parametrize("preset", PRESETS, ids=lambda path: path.stem)
def test_presets_describe_a_policy(preset, input_features, output_features):
    run = draccus.parse(TrainPipelineConfig, config_path=preset, args=["--dataset.repo_id=local/small"])
    image = PolicyFeature(FeatureType.VISUAL, (3, 96, 96))
    images = {key: image for key in getattr(run.policy, "inputs", None) or [] if key not in input_features}
    run.policy.input_features, run.policy.output_features = (
        {**input_features, **images},
        dict(output_features),
    )
    if images:
        run.policy.pretrained_backbone_weights = None  # they would be downloaded
    get_policy_class(run.policy.type)(run.policy)


def test_config_round_trip(config, policy, tmp_path):
    config._save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path) == config


def test_forward_and_backward(policy, batch):
    before = deepcopy(batch)
    loss, log = policy.train().forward(batch)
    loss.backward()
    assert loss.isfinite() and loss.ndim == 0
    assert log is None or all(isinstance(value, int | float) for value in log.values())
    assert all(p.grad is not None for p in policy.parameters() if p.requires_grad)
    assert batch.keys() == before.keys()
    assert all(torch.equal(batch[k], before[k]) for k in batch if isinstance(batch[k], torch.Tensor))


def test_forward_in_mixed_precision(policy, batch):
    with torch.autocast("cpu", torch.bfloat16):
        loss, _ = policy.train().forward(batch)
    loss.backward()
    assert all(p.grad.isfinite().all() for p in policy.parameters() if p.grad is not None)


def test_select_action_leaves_the_observation_alone(policy, config):
    seen = observation(config)
    before = deepcopy(seen)
    policy.eval()
    policy.reset()
    with torch.inference_mode():
        action = policy.select_action(seen)
    assert action.shape == (2, 2) and action.isfinite().all()
    assert seen.keys() == before.keys() and all(torch.equal(seen[k], before[k]) for k in before)


def test_held_out_loss_is_deterministic_and_without_gradients(policy, batch):
    policy.eval()
    losses = []
    for _ in range(2):
        torch.manual_seed(1)
        with torch.no_grad():
            losses.append(policy.forward(batch)[0])
    assert torch.equal(losses[0], losses[1])
    assert not losses[0].requires_grad


@pytest.mark.parametrize("given_state_dict", [False, True])
def test_save_and_load(policy, tmp_path, given_state_dict):
    policy.save_pretrained(tmp_path, state_dict=policy.state_dict() if given_state_dict else None)
    saved = load_file(tmp_path / "model.safetensors")
    loaded = type(policy).from_pretrained(tmp_path, strict=True)
    for key, value in policy.state_dict().items():
        assert torch.equal(value, loaded.state_dict()[key]), key
        assert key in saved


def test_optimizer_preset_trains_every_parameter(policy, config):
    run = SimpleNamespace(
        use_policy_training_preset=True,
        trainable_config=config,
        policy=config,
        optimizer=config.get_optimizer_preset(),
        scheduler=config.get_scheduler_preset(),
        steps=10,
    )
    optimizer, _ = make_optimizer_and_scheduler(run, policy)
    trained = [id(p) for group in optimizer.param_groups for p in group["params"]]
    assert len(trained) == len(set(trained))
    assert set(trained) == {id(p) for p in policy.parameters() if p.requires_grad}


def test_processors_round_trip(config, policy, batch, dataset, tmp_path):
    pre, post = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    pre.save_pretrained(tmp_path)
    post.save_pretrained(tmp_path)
    pre2, post2 = make_pre_post_processors(config, pretrained_path=str(tmp_path))
    processed, processed2 = pre(deepcopy(batch)), pre2(deepcopy(batch))
    for key in ("action", *config.input_features):
        assert torch.equal(processed[key], processed2[key])
    torch.testing.assert_close(post(processed["action"]), batch["action"], atol=1e-4, rtol=0)
    assert torch.equal(post(batch["action"].clone()), post2(batch["action"].clone()))


def test_moves_between_precisions(policy):
    before = {key: value.clone() for key, value in policy.state_dict().items()}
    policy.to(torch.float64).to(torch.float32)
    assert all(torch.equal(before[key], value) for key, value in policy.state_dict().items())


@pytest.mark.parametrize(
    ("case", "history", "loss", "grad_norm", "n_parameters", "actions"),
    [
        ("agpd", (), 3.4338076, 12.5141315, 34018, 1.1267710),
        ("dp-mlp", (2,), 0.3442916, 0.1253975, 18912, -0.6403990),
        ("dp-t", (2,), 0.3732229, 0.2842617, 6914, -0.4353137),
        ("dp-c", (2,), 0.3532942, 0.2268925, 160418, 0.5731734),
        ("agpd-dp", (2,), 0.3442916, 0.1253975, 18912, -0.6403990),
        ("act-dp", (1,), 0.3547188, 0.1246375, 16322, -0.0028088),
    ],
)
def test_golden_scalars(
    input_features, output_features, case, history, loss, grad_norm, n_parameters, actions
):
    """Loss, gradient, size and actions at fixed weights, data and seeds: a change of any is on purpose."""
    config = make_config(case, input_features=dict(input_features), output_features=dict(output_features))
    policy = get_policy_class(config.type)(config).train()
    torch.manual_seed(0)
    for parameter in policy.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    shapes = {key: feature.shape for key, feature in input_features.items()}
    batch = {key: series(3, *history, *shape) for key, shape in shapes.items()}
    batch |= {"action": series(3, 8, 2), "action_is_pad": torch.zeros(3, 8, dtype=torch.bool)}
    torch.manual_seed(1)
    batch_loss, _ = policy.forward(batch)
    batch_loss.backward()
    squares = [p.grad.square().sum() for p in policy.parameters() if p.grad is not None]
    policy.eval()
    torch.manual_seed(2)
    action = policy.select_action({key: series(3, *shape) for key, shape in shapes.items()})

    scalars = (batch_loss.item(), sum(squares).sqrt().item(), action.sum().item())
    assert scalars == pytest.approx((loss, grad_norm, actions), rel=1e-3, abs=1e-4)
    assert sum(parameter.numel() for parameter in policy.parameters()) == n_parameters
