"""The ACT student: its prior chunk, what it saves, what its optimizer gets."""

import json

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy

from lerobot_agpd.config import (
    AdversaryConfig,
    CollectConfig,
    GuidanceConfig,
    ReplayConfig,
    RepresentationConfig,
    TeacherConfig,
)
from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.guidance.representation import LR
from lerobot_agpd.policies.agpd.configuration_agpd import AGPDConfig
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy

B = 5


@pytest.fixture
def policy(agpd_config) -> AGPDPolicy:
    return AGPDPolicy(agpd_config(representation=RepresentationConfig("state")))


@pytest.fixture
def batch():
    return {
        "observation.state": torch.randn(B, 2),
        "observation.environment_state": torch.randn(B, 3),
        "action": torch.randn(B, 8, 2),
        "action_is_pad": torch.zeros(B, 8, dtype=torch.bool),
    }


# ---- the prior chunk ----


def test_prior_chunk_does_not_depend_on_the_actions(policy, batch):
    policy.train()
    prior = policy.prior_chunk(batch)
    other = policy.prior_chunk({**batch, "action": torch.randn(B, 8, 2) * 100})
    assert torch.equal(prior.chunk, other.chunk) and torch.equal(prior.embedding, other.embedding)
    del batch["action"], batch["action_is_pad"]
    assert torch.equal(policy.prior_chunk(batch).chunk, prior.chunk)
    assert prior.chunk.shape == (B, 8, 2) and prior.embedding.shape == (B, policy.embedding_dim)


def test_act_in_training_mode_does_look_at_the_actions(policy, batch):
    """What the prior chunk is there for."""
    policy.train()
    for module in policy.modules():
        if isinstance(module, torch.nn.Dropout):
            module.p = 0.0
    with torch.random.fork_rng():
        torch.manual_seed(1)
        seen = policy.model(batch)[0]
        torch.manual_seed(1)
        other = policy.model({**batch, "action": batch["action"] * 100})[0]
    assert not torch.allclose(seen, other)


@pytest.mark.parametrize("training", [True, False])
def test_prior_chunk_is_what_would_be_executed(policy, batch, training):
    policy.train(training)
    chunk = policy.prior_chunk(batch).chunk
    assert all(module.training == training for module in policy.modules())
    torch.testing.assert_close(chunk, policy.predict_action_chunk(batch), rtol=1e-5, atol=1e-5)


def test_prior_chunk_leaves_the_random_state_alone(policy, batch):
    policy.train()
    before = torch.get_rng_state()
    policy.prior_chunk(batch)
    assert torch.equal(torch.get_rng_state(), before)


def test_prior_chunk_has_gradients_and_leaves_no_hook(policy, batch):
    policy.train()
    prior = policy.prior_chunk(batch)
    (prior.chunk.sum() + prior.embedding.sum()).backward()
    heads = [
        policy.model.action_head,
        policy.model.encoder_env_state_input_proj,
        policy.model.encoder.layers[0],
    ]
    assert all(p.grad.abs().sum() > 0 for head in heads for p in head.parameters() if p.grad is not None)
    assert policy.model.action_head.weight.grad is not None
    assert not policy.model.encoder._forward_hooks


def test_training_mode_survives_a_failing_prior_chunk(policy, batch):
    policy.train()
    with pytest.raises(RuntimeError):
        policy.prior_chunk({**batch, "observation.state": torch.zeros(B, 99)})
    assert policy.model.training and not policy.model.encoder._forward_hooks


# ---- LeRobot's ACT ----


@pytest.fixture
def act(policy) -> ACTPolicy:
    """LeRobot's own ACT with the student's weights."""
    own = {name: getattr(policy.config, name) for name in ACTConfig.__dataclass_fields__}
    act = ACTPolicy(ACTConfig(**own))
    weights = policy.state_dict()
    act.load_state_dict({key: weights[key] for key in act.state_dict()})
    return act.eval()


def test_in_eval_mode_it_is_lerobots_act(policy, act, batch):
    policy.eval()
    assert torch.equal(policy.predict_action_chunk(batch), act.predict_action_chunk(batch))
    for _ in range(6):  # beyond one queue of 4 actions
        observation = {key: value for key, value in batch.items() if key.startswith("observation")}
        assert torch.equal(policy.select_action(observation), act.select_action(observation))
    loss, log = policy.forward(batch)
    assert torch.equal(loss, act.forward(batch)[0]) and log["l1_loss"] == pytest.approx(loss.item())


def test_chunked_batches_train_like_lerobots_act(policy, act, batch):
    """Batches that hold chunks pass through: no replay, no adversary."""
    policy.train(), act.train()
    losses = []
    for module in (policy, act):
        torch.manual_seed(3)
        losses.append(module.forward(batch)[0])
    assert torch.equal(*losses)


def test_single_frames_without_a_dataset_are_refused(policy, batch):
    policy.train()
    with pytest.raises(ValueError, match="without dataset_meta"):
        policy.forward({**batch, "action": batch["action"][:, 0], "index": torch.arange(B)})


def test_update_before_training_does_nothing(policy):
    before = {key: value.clone() for key, value in policy.state_dict().items()}
    policy.update()
    assert all(torch.equal(value, before[key]) for key, value in policy.state_dict().items())


# ---- what is saved ----


def test_state_dict_holds_act_and_the_two_networks_alone(policy):
    owners = {key.split(".", 1)[0] for key in policy.state_dict()}
    assert owners == {"model", "discriminator", "representation"}
    assert not [key for key in policy.state_dict() if "teacher" in key]


def test_networks_that_are_off_are_not_built(agpd_config):
    policy = AGPDPolicy(agpd_config(adversary=AdversaryConfig(weight=0)))
    assert {key.split(".", 1)[0] for key in policy.state_dict()} == {"model"}


def test_checkpoint_loads_without_teacher_dataset_or_environment(policy, batch, tmp_path):
    policy.config.teacher.path = "nowhere/teacher"
    policy.save_pretrained(tmp_path)
    loaded = AGPDPolicy.from_pretrained(tmp_path)
    policy.eval()
    assert torch.equal(loaded.predict_action_chunk(batch), policy.predict_action_chunk(batch))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["config.json", "model.safetensors"]


@EnvConfig.register_subclass("agpd_test_env")
class AnyEnv(EnvConfig):
    @property
    def gym_kwargs(self):
        return {}


def test_config_round_trip_with_its_groups_and_without_environment(agpd_config, tmp_path):
    config = agpd_config(
        teacher=TeacherConfig(path="some/teacher", num_inference_steps=7, noise_scheduler="DDIM"),
        guidance=GuidanceConfig(scale=0.75, at="mu", adaptive=False),
        collect=CollectConfig(env=AnyEnv(), strategy="teacher", rounds=3, min_reward=0.9, n_action_steps=2),
        replay=ReplayConfig(root="somewhere", collected_fraction=0.25),
        adversary=AdversaryConfig(every=3),
        representation=RepresentationConfig("state"),
    )
    config.save_pretrained(tmp_path)
    assert isinstance(config.collect.env, AnyEnv)  # the run's own config keeps it
    entries = json.loads((tmp_path / "config.json").read_text())
    assert entries["type"] == "agpd" and entries["collect"]["env"] is None
    loaded = PreTrainedConfig.from_pretrained(tmp_path)
    assert isinstance(loaded, AGPDConfig)
    for group in ("teacher", "guidance", "replay", "adversary", "representation"):
        assert getattr(loaded, group) == getattr(config, group)
    config.collect.env = None
    assert loaded.collect == config.collect
    assert (loaded.dim_model, loaded.chunk_size, loaded.n_action_steps) == (32, 8, 4)


def test_the_loader_is_asked_for_single_frames(agpd_config):
    config = agpd_config()
    assert config.action_delta_indices is None and config.observation_delta_indices is None


# ---- the optimizer ----


def test_optimizer_groups_partition_the_parameters(policy):
    frozen = policy.model.action_head.bias.requires_grad_(False)
    groups = policy.get_optim_params()
    given = [id(p) for group in groups for p in group["params"]]
    trainable = {id(p) for p in policy.parameters() if p.requires_grad}
    assert len(given) == len(set(given)) and set(given) == trainable and id(frozen) not in given
    by_lr = {group["lr"]: {id(p) for p in group["params"]} for group in groups if "lr" in group}
    config = policy.config
    assert by_lr[config.adversary.lr] == {id(p) for p in policy.discriminator.parameters()}
    assert by_lr[LR] == {id(p) for p in policy.representation.parameters()}
    assert torch.optim.AdamW(groups, lr=1e-5)


def test_parameter_groups_are_named(policy):
    groups = policy.parameter_groups()
    assert list(groups) == ["student", "discriminator", "representation"]
    assert {id(p) for p in groups["student"]} == {id(p) for p in policy.model.parameters()}


# ---- flags ----


def test_more_executed_steps_than_the_chunk_has_are_refused(agpd_config):
    with pytest.raises(FlagError, match="--policy.collect.n_action_steps=9.*--policy.chunk_size=8"):
        agpd_config(collect=CollectConfig(n_action_steps=9))


def test_representation_of_images_alone_is_refused(agpd_config):
    images = {"observation.image": PolicyFeature(FeatureType.VISUAL, (3, 32, 32))}
    options = {"representation": RepresentationConfig("state"), "pretrained_backbone_weights": None}
    with pytest.raises(FlagError, match="--policy.representation.type"):
        AGPDPolicy(agpd_config(input_features=images, **options))
