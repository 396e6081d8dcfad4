"""Every policy type on Push-T: trained, resumed, evaluated; as teacher and as student."""

import json
import shutil
from pathlib import Path

import pytest
from commands import QUIET, TINY_STUDENT, dataset_flags, last_checkpoint, reports, run_here
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from pusht import record
from safetensors.torch import load_file

pytestmark = pytest.mark.slow

PUSHT = ["--env.type=pusht", "--env.obs_type=environment_state_agent_pos", "--env.episode_length=16"]
SAMPLER = ["--policy.noise_scheduler_type=DDIM", "--policy.num_inference_steps=5"]
COMMON = [*QUIET, "--policy.device=cpu", "--policy.push_to_hub=false", "--batch_size=8", *SAMPLER]
DENOISERS = {
    "mlp": ["--policy.denoiser=mlp", "--policy.mlp.width=32", "--policy.mlp.n_blocks=1"],
    "unet": ["--policy.denoiser=unet", "--policy.down_dims=[16,32]", "--policy.diffusion_step_embed_dim=16"],
    "transformer": [
        "--policy.denoiser=transformer",
        "--policy.transformer.width=16",
        "--policy.transformer.n_layers=1",
        "--policy.transformer.n_heads=2",
    ],
}
TEACHERS = {
    **{name: ["--policy.type=diffusion_transformer", *flags] for name, flags in DENOISERS.items()},
    "act_diffusion": [
        "--policy.type=act_diffusion",
        "--policy.dim_model=16",
        "--policy.n_heads=2",
        "--policy.dim_feedforward=32",
        "--policy.n_encoder_layers=1",
        "--policy.horizon=16",
        "--policy.n_action_steps=8",
        "--policy.transformer.width=16",
        "--policy.transformer.n_layers=1",
        "--policy.transformer.n_heads=2",
    ],
}
ROUNDS = [
    "--policy.collect.warmup=2",
    "--policy.collect.every=2",
    "--policy.collect.episodes=2",
    "--policy.collect.min_reward=1e-6",
    "--policy.adversary.start=0",
]


@pytest.fixture(scope="module")
def demos(tmp_path_factory) -> Path:
    return record(tmp_path_factory.mktemp("pusht") / "demos", pixels=False)


def resume(output: Path, step: str) -> None:
    """Forget what came after a checkpoint, and continue from it."""
    config = output / "checkpoints" / step / "pretrained_model" / "train_config.json"
    run_here("lerobot-train", f"--config_path={config}", "--resume=true", f"--output_dir={output}")


@pytest.mark.parametrize("kind", TEACHERS)
def test_teacher(kind: str, demos: Path, tmp_path: Path) -> None:
    teacher = tmp_path / "teacher"
    flags = [*TEACHERS[kind], *COMMON, *dataset_flags(demos), "--steps=4", "--save_freq=2"]
    run_here("lerobot-train", *flags, f"--output_dir={teacher}")
    shutil.rmtree(teacher / "checkpoints" / "000004")
    resume(teacher, "000002")
    averaged = load_file(teacher / "checkpoints" / "000004" / "pretrained_model" / "model.safetensors")
    assert averaged and all(weights.isfinite().all() for weights in averaged.values())
    student = tmp_path / "student"
    run_here(
        "lerobot-train",
        *TINY_STUDENT,
        *ROUNDS,
        *PUSHT,
        *dataset_flags(demos),
        f"--policy.teacher.path={last_checkpoint(teacher)}",
        "--steps=4",
        f"--output_dir={student}",
    )
    report = reports(student)[0]
    assert report["total"]["generated"] == 2 and report["mean_guidance_shift"] > 0
    evaluated = tmp_path / "eval"
    run_here(
        "lerobot-eval",
        f"--policy.path={last_checkpoint(teacher)}",
        "--policy.device=cpu",
        *PUSHT,
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        "--eval.use_async_envs=false",
        f"--output_dir={evaluated}",
    )
    assert json.loads((evaluated / "eval_info.json").read_text())["overall"]["n_episodes"] == 1


@pytest.mark.parametrize("denoiser", ["unet", "transformer"])
def test_self_distillation(denoiser: str, demos: Path, tmp_path: Path) -> None:
    """No teacher: round 0 runs unguided, the later ones are guided toward the snapshot before."""
    output = tmp_path / "run"
    run_here(
        "lerobot-train",
        "--policy.type=agpd_diffusion",
        *DENOISERS[denoiser],
        *COMMON,
        *ROUNDS,
        *PUSHT,
        *dataset_flags(demos),
        "--steps=7",
        "--save_freq=3",
        f"--output_dir={output}",
    )
    rounds = reports(output)
    assert [report["strength"] > 0 for report in rounds] == [False, True, True]
    assert [report["strategy"]["generated"] for report in rounds] == [0, 2, 2]
    # As much of the default pull as five DDIM steps follow; an unguided round does not move it.
    assert rounds[0]["next_strength"] == pytest.approx(0.498, abs=1e-3)
    assert rounds[1]["mean_discrepancy"] > 0

    checkpoint = output / "checkpoints" / "000006" / "pretrained_model"
    assert (checkpoint / "previous_self.safetensors").is_file()
    shutil.rmtree(output / "checkpoints" / "000007")
    resume(output, "000006")
    assert (output / "checkpoints" / "000007").is_dir()

    plain = tmp_path / "plain"
    if denoiser == "unet":
        run_here("lerobot-agpd-export", f"--checkpoint={last_checkpoint(output)}", f"--output={plain}")
        assert DiffusionPolicy.from_pretrained(plain, strict=True).config.type == "diffusion"
    else:
        with pytest.raises(SystemExit, match="denoiser 'transformer'"):
            run_here("lerobot-agpd-export", f"--checkpoint={last_checkpoint(output)}", f"--output={plain}")


def test_diffusion_student_of_a_teacher(demos: Path, tmp_path: Path, capfd) -> None:
    """A diffusion student learns from another diffusion policy, against the adversary."""
    teacher, student = tmp_path / "teacher", tmp_path / "student"
    flags = [*TEACHERS["mlp"], *COMMON, *dataset_flags(demos), "--steps=2"]
    run_here("lerobot-train", *flags, f"--output_dir={teacher}")
    run_here(
        "lerobot-train",
        "--policy.type=agpd_diffusion",
        *DENOISERS["mlp"],
        *COMMON,
        *ROUNDS,
        *PUSHT,
        *dataset_flags(demos),
        f"--policy.teacher.path={last_checkpoint(teacher)}",
        "--log_freq=1",
        "--steps=4",
        f"--output_dir={student}",
    )
    assert "discriminator_accuracy" in capfd.readouterr().err
    report = reports(student)[0]
    assert report["strength"] == pytest.approx(0.498, abs=1e-3) and report["strategy"]["generated"] == 2
