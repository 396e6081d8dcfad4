"""Students and teachers as plain LeRobot checkpoints."""

import pickle

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_pre_post_processors
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy

from lerobot_agpd.cli.export import ExportConfig, export, export_graph, load
from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.policies.agpd_diffusion.modeling_agpd_diffusion import AGPDDiffusionPolicy
from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
)
from lerobot_agpd.policies.diffusion_transformer.modeling_diffusion_transformer import (
    DiffusionTransformerPolicy,
)

UNET = {"denoiser": "unet", "down_dims": (16, 32), "diffusion_step_embed_dim": 16, "n_groups": 4}


@pytest.fixture
def saved(tmp_path, demonstrations):
    """Writes a policy with its processors."""

    def save(policy, statistics=None):
        folder = tmp_path / "checkpoint"
        policy.eval().save_pretrained(folder)
        statistics = statistics or demonstrations.meta.stats
        for processor in make_pre_post_processors(policy.config, dataset_stats=statistics):
            processor.save_pretrained(folder)
        return folder

    return save


def observations(n_obs_steps: int | None) -> dict[str, torch.Tensor]:
    shape = (3,) if n_obs_steps is None else (3, n_obs_steps)
    return {
        "observation.state": torch.randn(*shape, 2),
        "observation.environment_state": torch.randn(*shape, 3),
    }


def test_an_act_student_becomes_an_act_policy(saved, agpd_config, tmp_path):
    policy = AGPDPolicy(agpd_config())
    export(ExportConfig(checkpoint=str(saved(policy)), output=tmp_path / "act"))
    plain = ACTPolicy.from_pretrained(tmp_path / "act", strict=True)
    batch = observations(None)
    difference = plain.predict_action_chunk(batch) - policy.predict_action_chunk(batch)
    assert difference.abs().max() <= 1e-6
    assert (tmp_path / "act" / "policy_preprocessor.json").is_file()


def test_a_unet_student_becomes_a_diffusion_policy(saved, agpd_diffusion_config, tmp_path):
    policy = AGPDDiffusionPolicy(agpd_diffusion_config(**UNET))
    export(ExportConfig(checkpoint=str(saved(policy)), output=tmp_path / "plain"))
    plain = DiffusionPolicy.from_pretrained(tmp_path / "plain", strict=True)
    assert type(plain.config).__name__ == "DiffusionConfig"
    batch, noise = observations(2), torch.randn(3, 8, 2)
    difference = plain.predict_action_chunk(batch, noise=noise) - policy.predict_action_chunk(
        batch, noise=noise
    )
    assert difference.abs().max() <= 1e-6


def test_networks_that_lerobot_does_not_have_are_refused(saved, input_features, output_features, tmp_path):
    features = {"input_features": input_features, "output_features": output_features}
    policy = DiffusionTransformerPolicy(
        DiffusionTransformerConfig(**features, push_to_hub=False, device="cpu")
    )
    with pytest.raises(ValueError, match="'diffusion_transformer' with denoiser 'mlp'.*denoiser=unet"):
        export(ExportConfig(checkpoint=str(saved(policy)), output=tmp_path / "plain"))
    assert not (tmp_path / "plain").exists()


def test_nothing_is_overwritten(tmp_path):
    with pytest.raises(FileExistsError, match="--output=.*already exists"):
        ExportConfig(checkpoint="anything", output=tmp_path)


class TestOnnx:
    """The graph is the policy with its processors."""

    @pytest.mark.slow
    def test_a_student_with_a_camera(self, saved, agpd_config, demonstrations, tmp_path, caplog):
        onnxruntime = pytest.importorskip("onnxruntime")
        camera = "observation.images.top"
        features = {
            "observation.state": PolicyFeature(FeatureType.STATE, (2,)),
            camera: PolicyFeature(FeatureType.VISUAL, (3, 32, 32)),
        }
        policy = AGPDPolicy(agpd_config(input_features=features, pretrained_backbone_weights=None))
        statistics = {camera: {"mean": torch.full((3, 1, 1), 0.4), "std": torch.full((3, 1, 1), 0.3)}}
        folder = saved(policy, {**demonstrations.meta.stats, **statistics})
        config = ExportConfig(checkpoint=str(folder), output=tmp_path / "graph", format="onnx")
        export_graph(config)
        session = onnxruntime.InferenceSession(tmp_path / "graph" / "policy.onnx")
        observation = {"observation.state": torch.randn(5, 2), camera: torch.rand(5, 3, 32, 32)}
        (chunk,) = session.run(None, {key: value.numpy() for key, value in observation.items()})
        loaded = load(config)
        expected = loaded.postprocessor(loaded.policy.predict_action_chunk(loaded.preprocessor(observation)))
        assert chunk.shape == (5, 8, 2)
        assert abs(chunk - expected.numpy()).max() <= 1e-5

    def test_a_policy_that_denoises_is_refused(self, saved, agpd_diffusion_config, tmp_path):
        policy = AGPDDiffusionPolicy(agpd_diffusion_config())
        config = ExportConfig(checkpoint=str(saved(policy)), output=tmp_path / "graph", format="onnx")
        with pytest.raises(FlagError, match="--format=onnx"):
            export_graph(config)
        assert not (tmp_path / "graph").exists()


def test_lerobots_policy_server_runs_the_plain_checkpoint(saved, agpd_config, tmp_path, monkeypatch):
    """The server's own calls, without its network."""
    pytest.importorskip("grpc")
    monkeypatch.chdir(tmp_path)  # where it puts its logs
    from lerobot.async_inference.configs import PolicyServerConfig
    from lerobot.async_inference.helpers import RemotePolicyConfig, TimedObservation
    from lerobot.async_inference.policy_server import PolicyServer
    from lerobot.transport import services_pb2

    features = {"observation.state": PolicyFeature(FeatureType.STATE, (2,))}
    camera = "observation.images.top"
    features[camera] = PolicyFeature(FeatureType.VISUAL, (3, 32, 32))
    policy = AGPDPolicy(agpd_config(input_features=features, pretrained_backbone_weights=None))
    export(ExportConfig(checkpoint=str(saved(policy)), output=tmp_path / "act"))

    class Client:
        def peer(self):
            return "test"

    robot = {
        "observation.state": {"dtype": "float32", "shape": (2,), "names": ["x.pos", "y.pos"]},
        camera: {"dtype": "image", "shape": (32, 32, 3), "names": ["height", "width", "channels"]},
    }
    server = PolicyServer(PolicyServerConfig())
    server.Ready(services_pb2.Empty(), Client())
    instructions = RemotePolicyConfig("act", str(tmp_path / "act"), robot, actions_per_chunk=6)
    server.SendPolicyInstructions(services_pb2.PolicySetup(data=pickle.dumps(instructions)), Client())
    image = np.zeros((32, 32, 3), dtype=np.uint8)
    raw = {"x.pos": 0.5, "y.pos": -0.5, "top": image, "task": "a small task"}
    server._enqueue_observation(TimedObservation(timestamp=0.0, timestep=0, observation=raw, must_go=True))
    actions = pickle.loads(server.GetActions(services_pb2.Empty(), Client()).data)
    assert [action.get_timestep() for action in actions] == list(range(6))
    loaded = load(ExportConfig(checkpoint=str(tmp_path / "checkpoint"), output=tmp_path / "unused"))
    observation = {"observation.state": torch.tensor([[0.5, -0.5]]), camera: torch.zeros(1, 3, 32, 32)}
    expected = loaded.postprocessor(loaded.policy.predict_action_chunk(loaded.preprocessor(observation)))
    got = torch.stack([action.get_action() for action in actions])
    assert torch.allclose(got, expected[0, :6], atol=1e-5)
