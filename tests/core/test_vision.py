"""Students that see cameras: a teacher that sees the state, and J on visual features."""

import shutil
import sys

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from point_camera import ENV, IMAGE, MASK, SIZE, STATE, PointCameraEnv, StateTeacher, demonstrate
from point_environment import GAIN
from toy_run import Run
from transformers import Dinov2Config, Dinov2Model

from lerobot_agpd import build as builders
from lerobot_agpd.config import (
    AdversaryConfig,
    CollectConfig,
    GuidanceConfig,
    ReplayConfig,
    RepresentationConfig,
    TeacherConfig,
)
from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.guidance.visual import MAP_SIZE
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.replay import frame_features
from lerobot_agpd.run import RunInfo

FEATURES = {
    STATE: PolicyFeature(FeatureType.STATE, (2,)),
    ENV: PolicyFeature(FeatureType.ENV, (3,)),
    IMAGE: PolicyFeature(FeatureType.VISUAL, (3, SIZE, SIZE)),
}


@pytest.fixture(scope="module")
def camera_demonstrations(tmp_path_factory):
    return demonstrate(tmp_path_factory.mktemp("data") / "point_camera")


@pytest.fixture(scope="module")
def dino(tmp_path_factory) -> str:
    """Folder of a tiny random DINOv2 with patches of 6 pixels."""
    folder = tmp_path_factory.mktemp("dino")
    torch.manual_seed(0)
    sizes = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "mlp_ratio": 2}
    Dinov2Model(Dinov2Config(image_size=24, patch_size=6, **sizes)).save_pretrained(folder)
    return str(folder)


@pytest.fixture
def start(agpd_config, camera_demonstrations, tmp_path, monkeypatch):
    """Starts a run in which the teacher sees the environment state and the student what `inputs` says."""
    teacher = StateTeacher()
    monkeypatch.setattr(builders, "load_teacher", lambda config, device: teacher)

    def start(dataset=camera_demonstrations, env=None, inputs=(STATE, IMAGE), collect=None, **options) -> Run:
        torch.manual_seed(0)
        present = {key: feature for key, feature in FEATURES.items() if key in dataset.features}
        settings = {"warmup": 3, "every": 3, "episodes": 6, "n_envs": 3, "diagnostics": False}
        config = agpd_config(
            input_features=present,
            inputs=None if inputs is None else list(inputs),
            encoder="small",
            teacher=TeacherConfig(path="a/toy"),
            guidance=GuidanceConfig(scale=0.25),
            adversary=AdversaryConfig(start=2),
            collect=CollectConfig(**{**settings, "n_action_steps": 2, **(collect or {})}),
            **options,
        )
        run = RunInfo(output_dir=tmp_path / "run", env=env or PointCameraEnv(), steps=10)
        policy = AGPDPolicy(config, dataset.meta.stats, dataset.meta, run=run)
        return Run(policy, dataset)

    return start


def test_a_teacher_that_sees_the_state_teaches_a_student_that_sees_images(start, camera_demonstrations):
    run = start(replay=ReplayConfig(relabel="all")).train(until=8)
    assert list(run.policy.config.input_features) == [STATE, IMAGE]
    replay, n_demonstrated = run.agpd.replay, len(camera_demonstrations)
    assert replay.n_collected_frames > 0 and {log["discriminator_loss"] for log in run.logs[3:]} != {0.0}
    # The teacher's chunks at frames of both kinds follow from the environment state, which no batch holds.
    frames = torch.tensor([0, 3, n_demonstrated, n_demonstrated + 2])
    chunks, n_shared = run.agpd.teacher_chunks.at(frames)
    assert n_shared > 0 and ENV not in run.agpd.train_batch(run.batch())
    raw = replay.demonstrations.normalizer.unnormalize("action", chunks[:, 0])
    torch.testing.assert_close(raw, -GAIN * replay.table.columns[STATE][frames], atol=0.1, rtol=0)
    assert replay.table.columns[ENV].shape == (len(replay.table), 3)


def test_a_round_and_the_demonstrations_hold_everything(start):
    run = start().train(until=3)
    (episode, *_) = run.agpd.journal.kept(0)
    assert {STATE, ENV, IMAGE} <= set(episode.observations)
    assert episode.column(IMAGE).shape[1:] == (SIZE, SIZE, 3)
    dot = episode.column(IMAGE).max(axis=(1, 2, 3))
    assert (dot == 255).all()


def test_all_inputs_are_the_default(start):
    assert list(start(inputs=None).policy.config.input_features) == [STATE, ENV, IMAGE]


def test_an_input_that_the_demonstrations_lack(start):
    with pytest.raises(
        FlagError, match=r"--policy.inputs=.*\['observation.images.top'\] .*observation.image'"
    ):
        start(inputs=(STATE, "observation.images.top"))


def test_demonstrations_without_what_the_teacher_sees(start, tmp_path):
    blind = demonstrate(tmp_path / "blind", left_out=(ENV, MASK))
    with pytest.raises(FlagError, match=rf"needs the observations .*{ENV}.* has .*{IMAGE}.*differ in"):
        start(dataset=blind)


def test_an_environment_without_what_the_teacher_sees(start):
    env = PointCameraEnv(shown=("agent_pos", "pixels"))
    with pytest.raises(
        FlagError, match=rf"the teacher observes \['{ENV}'\].*delivers \['{IMAGE}', '{STATE}'\]"
    ):
        start(env=env)


def test_images_of_another_size_are_refused_before_training(start):
    with pytest.raises(ValueError, match=rf"'{IMAGE}' with shape \(30, 30, 3\).*\(24, 24, 3\)"):
        start(env=PointCameraEnv(size=30))


# ---- backgrounds ----


def test_training_images_get_other_backgrounds(start, tmp_path):
    masked, alone = demonstrate(tmp_path / "masked", left_out=()), {"every": 0}
    plain_run = start(masked, collect=alone)
    run = start(masked, collect=alone, replay=ReplayConfig(backgrounds="noise"))
    plain, other = (each.agpd.train_batch(each.batch())[IMAGE] for each in (plain_run, run))
    top, bottom = slice(0, SIZE // 2), slice(SIZE // 2, SIZE)
    torch.testing.assert_close(other[..., top, :], plain[..., top, :])
    assert not torch.isclose(other[..., bottom, :], plain[..., bottom, :]).all()
    torch.testing.assert_close(run.agpd.replay.eval_batch(run.batch())[IMAGE], plain)


def test_backgrounds_without_masks_are_refused(start):
    with pytest.raises(FlagError, match="the demonstrations.*lack.*observation.image_mask.*--env.masks=true"):
        start(replay=ReplayConfig(backgrounds="noise"))


# ---- J on what cameras see ----


@pytest.mark.parametrize("encoder", ["student", "dino"])
def test_a_visual_discrepancy_guides(start, dino, encoder):
    name = dino if encoder == "dino" else encoder
    run = start(representation=RepresentationConfig("visual", name)).train(until=8)
    n_tokens = MAP_SIZE**2 if encoder == "dino" else 1
    assert run.policy.representation.n_tokens == n_tokens
    assert run.agpd.reports[0].mean_guidance_shift > 0
    losses = [log["representation_loss"] for log in run.logs]
    assert min(losses[-4:]) < losses[0] and sum(losses) > 0
    assert not any("encoder.model" in name for name in run.policy.state_dict()), "DINOv2 stays outside"


def test_features_of_a_frozen_encoder_are_computed_once_per_frame(start, dino, monkeypatch):
    monkeypatch.setattr(frame_features, "BLOCK", 4)  # several files
    run = start(representation=RepresentationConfig("visual", dino))
    agpd = run.agpd
    agpd.train_batch(run.batch())
    encoded, encode = [], agpd.frame_features._encode
    monkeypatch.setattr(
        agpd.frame_features, "_encode", lambda index: encoded.extend(index.tolist()) or encode(index)
    )
    index = torch.tensor([0, 5, 5, 9, 0])
    first, again = agpd.frame_features.at(index), agpd.frame_features.at(index)
    assert sorted(encoded) == [0, 5, 9] and torch.equal(first, again)
    torch.testing.assert_close(first, encode(index), atol=5e-3, rtol=0)  # half precision


def test_what_is_predicted_is_the_frame_after_the_executed_steps(start, dino):
    run = start(representation=RepresentationConfig("visual", dino))
    agpd = run.agpd
    agpd.train_batch(run.batch())
    starts, ends = agpd.replay.table.episode_bounds(torch.tensor([0]))
    last = int(ends) - 1
    future = agpd.replay.visual_future(torch.tensor([0, last]), agpd.frame_features, 2)
    torch.testing.assert_close(future.observation, agpd.frame_features.at(torch.tensor([0, last])))
    torch.testing.assert_close(future.later, agpd.frame_features.at(torch.tensor([2, last])))
    assert future.is_pad.tolist() == [False, True] and future.actions.shape == (2, 2, 2)


def test_a_checkpoint_with_the_students_features_loads_without_anything(start, tmp_path):
    run = start(representation=RepresentationConfig("visual", "student")).train(until=2)
    run.policy.save_pretrained(tmp_path / "checkpoint")
    loaded = AGPDPolicy.from_pretrained(tmp_path / "checkpoint")
    assert set(loaded.state_dict()) == set(run.policy.state_dict())


def test_a_student_acts_without_the_dino_that_it_was_trained_with(start, dino, tmp_path, caplog):
    moved = shutil.copytree(dino, tmp_path / "dino")
    run = start(representation=RepresentationConfig("visual", str(moved))).train(until=2)
    run.policy.save_pretrained(tmp_path / "checkpoint")
    shutil.rmtree(moved)
    loaded = AGPDPolicy.from_pretrained(tmp_path / "checkpoint")
    assert loaded.representation is None and "J cannot be computed" in caplog.text
    batch = run.batch()
    torch.testing.assert_close(loaded.predict_action_chunk(batch), run.policy.predict_action_chunk(batch))


def test_a_dino_needs_transformers(start, dino, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(
        FlagError, match="--policy.representation.encoder=.* needs the package 'transformers'"
    ):
        start(representation=RepresentationConfig("visual", dino))


@pytest.mark.parametrize(
    ("inputs", "representation", "message"),
    [
        ((STATE, IMAGE), RepresentationConfig("state"), "observation.state.*alone.*observation.image.*visual or action"),
        ((STATE, ENV), RepresentationConfig("visual"), "type=visual predicts what cameras see.*observation.state"),
        ((STATE, IMAGE), RepresentationConfig("visual", "/nowhere"), "--policy.representation.encoder='/nowhere'"),
    ],
)  # fmt: skip
def test_a_representation_of_what_the_student_does_not_see(start, inputs, representation, message):
    with pytest.raises(FlagError, match=message):
        start(inputs=inputs, representation=representation)
