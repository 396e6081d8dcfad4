"""What LeRobot demands of a policy type, checked for every type of this plugin."""

import inspect
from copy import deepcopy

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.optim.factory import make_optimizer_and_scheduler
from lerobot.policies import PreTrainedPolicy, get_policy_class, make_policy, make_pre_post_processors
from lerobot.policies.factory import make_policy_config
from safetensors.torch import load_file

AGPD = {"chunk_size": 8, "n_action_steps": 4, "dim_model": 32, "n_heads": 2, "dim_feedforward": 64}
TYPES = {
    "agpd": AGPD,
    "diffusion_transformer": {"horizon": 8, "n_action_steps": 4, "num_inference_steps": 2},
}


@pytest.fixture(params=TYPES, name="policy_type")
def policy_type_fixture(request) -> str:
    return request.param


@pytest.fixture
def config(policy_type):
    config = make_policy_config(policy_type, push_to_hub=False, device="cpu", **TYPES[policy_type])
    if policy_type == "agpd":  # the checks train without a teacher
        config.collect.every = 0
        config.adversary.weight = 0
    return config


@pytest.fixture
def policy(config, demonstrations) -> PreTrainedPolicy:
    return make_policy(config, ds_meta=demonstrations.meta)


def frames(dataset) -> dict:
    return torch.utils.data.default_collate([dataset[0], dataset[4], dataset[7]])


def observation() -> dict[str, torch.Tensor]:
    return {"observation.state": torch.rand(2, 2), "observation.environment_state": torch.rand(2, 3)}


def test_classes_are_found_by_name(policy_type):
    policy_class = get_policy_class(policy_type)
    assert policy_class.name == policy_type
    assert policy_class.config_class is PreTrainedConfig.get_choice_class(policy_type)
    parameter = inspect.signature(policy_class.__init__).parameters["config"]
    assert parameter.annotation is policy_class.config_class


def test_defaults_build_without_teacher_or_dataset(policy_type, input_features, output_features):
    config = make_policy_config(policy_type, push_to_hub=False, device="cpu")
    config.input_features, config.output_features = dict(input_features), dict(output_features)
    if policy_type == "diffusion_transformer":
        assert config.horizon == 16
    get_policy_class(policy_type)(config)


def test_config_round_trip(config, tmp_path):
    config._save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path) == config


def test_forward_and_select_action_leave_the_batch_alone(policy, demonstrations):
    batch = frames(demonstrations)
    before = deepcopy(batch)
    loss, _ = policy.train().forward(batch)
    loss.backward()
    assert batch.keys() == before.keys()
    assert all(torch.equal(batch[k], before[k]) for k in batch if isinstance(batch[k], torch.Tensor))

    seen = observation()
    before = deepcopy(seen)
    policy.eval()
    policy.reset()
    with torch.inference_mode():
        action = policy.select_action(seen)
    assert action.shape == (2, 2)
    assert all(torch.equal(seen[k], before[k]) for k in before)


def test_held_out_loss_is_deterministic_and_without_gradients(policy, demonstrations):
    policy.eval()
    losses = []
    for _ in range(2):
        torch.manual_seed(1)
        with torch.no_grad():
            losses.append(policy.forward(frames(demonstrations))[0])
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
    class Run:
        use_policy_training_preset = True
        trainable_config = policy = config
        optimizer = config.get_optimizer_preset()
        scheduler = config.get_scheduler_preset()
        steps = 10

    optimizer, _ = make_optimizer_and_scheduler(Run, policy)
    trained = [id(p) for group in optimizer.param_groups for p in group["params"]]
    assert len(trained) == len(set(trained))
    assert set(trained) == {id(p) for p in policy.parameters() if p.requires_grad}


def test_processors_round_trip(config, policy, demonstrations, tmp_path):
    pre, post = make_pre_post_processors(config, dataset_stats=demonstrations.meta.stats)
    pre.save_pretrained(tmp_path)
    post.save_pretrained(tmp_path)
    pre2, post2 = make_pre_post_processors(config, pretrained_path=str(tmp_path))
    item = frames(demonstrations)
    assert torch.equal(pre(deepcopy(item))["action"], pre2(deepcopy(item))["action"])
    assert torch.allclose(post(pre(deepcopy(item))["action"]), item["action"], atol=1e-4)
    assert torch.equal(post(item["action"].clone()), post2(item["action"].clone()))


def test_moves_between_precisions(policy):
    before = {key: value.clone() for key, value in policy.state_dict().items()}
    policy.to(torch.float64).to(torch.float32)
    assert all(torch.equal(before[key], value) for key, value in policy.state_dict().items())
