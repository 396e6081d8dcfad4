"""A teacher with two known ways, asked at recorded states."""

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tiny_policies import ACT, CAMERA, DIFFUSION, STATE, STATE_ONLY, WITH_CAMERA, make_policy, make_teacher

from lerobot_agpd.guidance.adapters.chunk import ChunkTeacher
from lerobot_agpd.studies.probe import TeacherProbe
from lerobot_agpd.studies.probe_states import RecordedStates
from lerobot_agpd.studies.probe_verdict import conclude

LENGTHS = (6, 3, 9, 4, 5)
ENV = "observation.environment_state"
WITH_ENV = {**STATE_ONLY, ENV: PolicyFeature(FeatureType.ENV, (3,))}  # ACT needs it, or a camera


class CoinTeacher(ChunkTeacher):
    """Three quarters of its chunks are near 0.5 in every entry, the others near -0.5; after step 1, all near 0.5."""

    def _sample_chunk(self, batch, guide, generator):
        step = batch[STATE][:, -1, 0]  # (B,) normalized: (step - 0.5) / 2
        shape = (len(step), self.n_chunk_steps, 2)
        coins = torch.rand(shape[:1], generator=generator) < 0.75
        sign = torch.where(coins | (step > 0.3), 1.0, -1.0)
        return 0.5 * sign[:, None, None] + 0.01 * torch.randn(shape, generator=generator)


def record(root, inputs=STATE_ONLY) -> LeRobotDataset:
    """Random episodes; the first state entry is the step."""
    rng = np.random.default_rng(0)
    shapes = {STATE: (3,), ENV: (3,), "action": (2,)}
    features = {key: {"dtype": "float32", "shape": shape, "names": None} for key, shape in shapes.items()}
    if CAMERA in inputs:
        names = ["height", "width", "channels"]
        features[CAMERA] = {"dtype": "image", "shape": (64, 64, 3), "names": names}
    dataset = LeRobotDataset.create(
        "local/recorded", fps=10, features=features, root=root, robot_type="none", use_videos=False
    )
    for length in LENGTHS:
        for step in range(length):
            frame = {key: rng.normal(size=shape).astype(np.float32) for key, shape in shapes.items()}
            frame[STATE][0] = step
            if CAMERA in inputs:
                frame[CAMERA] = rng.integers(0, 255, (64, 64, 3), dtype=np.uint8)
            dataset.add_frame({**frame, "task": "a task"})
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset("local/recorded", root=root)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> LeRobotDataset:
    return record(tmp_path_factory.mktemp("states") / "recorded")


@pytest.fixture
def coin() -> CoinTeacher:
    return CoinTeacher(*make_policy("act", WITH_ENV, **ACT))


def make_probe(teacher, dataset, n_states=12, n_samples=64, seed=0) -> TeacherProbe:
    states = RecordedStates(dataset, teacher, None, n_states, seed)
    return TeacherProbe(teacher, states, n_samples, seed)


def test_states_are_the_starts_and_frames_anywhere(recorded, coin):
    states = RecordedStates(recorded, coin, None, 12, 0)
    assert states.is_start.tolist() == [True] * len(LENGTHS) + [False] * 12
    assert states.index[:5].tolist() == [0, 6, 9, 18, 22]
    assert len(set(states.index[5:].tolist())) == 12, "no frame twice"
    history = states.history(torch.arange(len(states)))
    assert history[STATE][:, -1, 0].tolist() == [row["frame"] for row in states.whereabouts()]
    fewer = RecordedStates(recorded, coin, None, 3, 0)
    assert fewer.is_start.tolist() == [True] * 3 + [False] * 3
    assert RecordedStates(recorded, coin, None, 12, 1).index.tolist() != states.index.tolist()


def test_the_ways_and_their_weights_are_found_where_they_are(recorded, coin):
    probe = make_probe(coin, recorded, n_samples=128)
    evidence = probe.evidence(probe.pulls())
    early = [row["frame"] <= 1 for row in probe.states.whereabouts()]
    assert [len(ways) == 2 for ways in probe.ways] == early
    assert evidence.starts.several == evidence.starts.total == len(LENGTHS)
    assert 0 < evidence.states.several == sum(early[5:]) < evidence.states.total == 12
    weights = np.mean([ways.weights for ways in probe.ways if len(ways) == 2], axis=0)
    np.testing.assert_allclose(weights, [0.75, 0.25], atol=0.05)
    np.testing.assert_allclose(probe.ways[0].distances, [1.0], atol=0.02)
    assert evidence.median_is_way == 1 and evidence.mean_is_way == 0


def test_the_nearest_of_more_samples_is_more_often_on_the_target_s_way(recorded, coin):
    probe = make_probe(coin, recorded)
    alone, four, sixteen = probe.pulls()
    assert [pull.strategy for pull in (alone, four, sixteen)] == ["teacher", "nearest", "nearest"]
    assert alone.moved == 0 and alone.chooses < 0.85 < sixteen.chooses
    assert 0 < four.moved < sixteen.moved and max(alone.off, four.off, sixteen.off) < 0.1
    verdict = conclude(probe.evidence([alone, four, sixteen]))
    assert verdict.finding == "several ways, median a way" and "strategy=nearest" in verdict.flags


def test_a_teacher_that_predicts_in_one_pass_is_deterministic(recorded):
    teacher = make_teacher("act", WITH_ENV, **ACT)
    probe = make_probe(teacher, recorded, n_states=4, n_samples=24)
    pulls = probe.pulls()
    assert [pull.strategy for pull in pulls] == ["teacher", "nearest", "nearest"]
    assert all(pull.moved == 0 and pull.chooses is None for pull in pulls)
    assert conclude(probe.evidence(pulls)).finding == "deterministic"
    assert [steps for steps, _ in probe.latency()] == [None]


def test_a_probe_is_reproducible_and_leaves_the_teacher_as_it_was(recorded):
    teacher = make_teacher("diffusion", WITH_ENV, **DIFFUSION, num_inference_steps=6)
    first, second = (make_probe(teacher, recorded, n_states=2, n_samples=24) for _ in range(2))
    assert torch.equal(first.samples, second.samples) and first.pulls() == second.pulls()
    assert first.step_counts() == [1, 2, 4, 6]
    assert [steps for steps, _ in first.latency()] == [1, 2, 4, 6]
    assert teacher.n_denoising_steps == 6
    assert torch.equal(make_probe(teacher, recorded, n_states=2, n_samples=24).samples, first.samples)


def test_guidance_moves_a_teacher_with_cameras(tmp_path):
    dataset = record(tmp_path / "images", WITH_CAMERA)
    options = {**DIFFUSION, "crop_shape": None, "vision_backbone": "resnet18", "num_inference_steps": 10}
    teacher = make_teacher("diffusion", WITH_CAMERA, pretrained_backbone_weights=None, **options)
    probe = make_probe(teacher, dataset, n_states=2, n_samples=24)
    assert probe.samples.shape == (4, 24, 4, 2) and probe.states.has_cameras
    alone, *guided = [pull for pull in probe.pulls() if pull.strategy != "nearest"]
    assert alone.moved == 0 and guided[-1].moved > guided[0].moved > 0
