"""The commands of the tutorial and the recipes, as they stand there but for their sizes."""

import re
import shlex
import shutil
from pathlib import Path

import pytest
from commands import EXAMPLES, run_here
from pusht import record

pytestmark = pytest.mark.slow

DOCS = Path(__file__).parents[2] / "docs"
TUTORIAL, README = DOCS / "tutorial.md", DOCS.parent / "README.md"
BLOCK = re.compile(r"```bash\n(.*?)```", re.DOTALL)

LOOP = ["--steps=4", "--save_freq=4", "--log_freq=2", "--batch_size=8", "--num_workers=0"]
ACT = ["dim_model=32", "n_heads=2", "dim_feedforward=64", "chunk_size=8", "n_action_steps=8"]
ROUNDS = ["warmup=1", "every=2", "rounds=1", "episodes=2", "n_envs=2", "diagnostics=false"]
DENOISER = ["horizon=8", "n_action_steps=4", "drop_n_last_frames=3", "num_inference_steps=3"]
SIZES = {
    "student_cpu": [
        *(f"--policy.{flag}" for flag in ACT),
        "--policy.adversary.start=1",
        "--policy.adversary.every=1",
    ],
    "self_distill_cpu": [
        *(f"--policy.{flag}" for flag in (*DENOISER, "transformer.width=32", "transformer.n_layers=1")),
        "--policy.scheduler_warmup_steps=1",
    ],
    "teacher_cpu": [*(f"--policy.{flag}" for flag in (*DENOISER, "mlp.width=32", "mlp.n_blocks=1"))],
}
"""Preset to what makes its network tiny."""

SHORT = ["--env.episode_length=10"]
QUICK = {
    "lerobot-agpd-demos": ["--episodes=2"],
    "lerobot-agpd-report": [
        *SHORT,
        "--episodes=2",
        "--curve_episodes=0",
        "--batch_size=2",
        "--sheet_episodes=2",
    ],
    "lerobot-agpd-viz": [
        *SHORT,
        "--episodes=1",
        "--env.visualization_width=64",
        "--env.visualization_height=64",
    ],
    "lerobot-agpd-probe": ["--states=4", "--samples=24"],
    "lerobot-eval": [*SHORT, "--eval.n_episodes=2", "--eval.batch_size=2", "--eval.use_async_envs=false"],
}
"""Command to what makes it quick."""


def commands(page: Path) -> list[list[str]]:
    """Words of the commands on a page, in their order."""
    text = "\n".join(BLOCK.findall(page.read_text())).replace("\\\n", " ")
    return [words for line in text.splitlines() if (words := shlex.split(line, comments=True))]


def quick(words: list[str]) -> list[str]:
    """A command with tiny sizes; a flag that comes twice counts as it comes last."""
    command, *flags = words
    if command != "lerobot-train":
        return [command, *flags, *QUICK.get(command, [])]
    (preset,) = [Path(flag).stem for flag in flags if flag.startswith("--config_path=")]
    collects = preset != "teacher_cpu" and "--policy.collect.every=0" not in flags
    rounds = [f"--policy.collect.{flag}" for flag in ROUNDS] if collects else []
    short = SHORT if any(flag.startswith("--env.type") for flag in flags) else []
    return [command, *flags, *LOOP, *SIZES[preset], *rounds, *short]


def run_page(page: Path) -> None:
    for words in commands(page):
        run_here(*quick(words))


@pytest.fixture(scope="module")
def distilled(tmp_path_factory, request) -> Path:
    """A folder with what the recipes begin with: demonstrations, teacher and student."""
    folder = tmp_path_factory.mktemp("recipes")
    (folder / "examples").symlink_to(EXAMPLES)
    checkpoints = folder / "outputs" / "teacher" / "checkpoints" / "last"
    checkpoints.mkdir(parents=True)
    (checkpoints / "pretrained_model").symlink_to(EXAMPLES / "fetch_pick_and_place" / "teacher")
    (folder / "outputs" / "demonstrations").symlink_to(EXAMPLES / "fetch_pick_and_place" / "demonstrations")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        (distill,) = [words for words in commands(TUTORIAL) if "--output_dir=outputs/student" in words]
        run_here(*quick(distill))
    return folder


GENERATED = "model_card.md"  # of an example run: its commands name files that are not here
RECIPES = sorted(
    path for path in (DOCS / "recipes").glob("*.md") if path.name != GENERATED and commands(path)
)


@pytest.mark.parametrize("page", RECIPES, ids=lambda path: path.stem)
def test_a_recipe(page: Path, distilled: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(distilled)
    run_page(page)
    made = {
        word.partition("=")[2]
        for words in commands(page)
        for word in words
        if re.match(r"--(output|output_dir|root|animation|png)=outputs/", word)
    }
    assert [path for path in made if not (distilled / path).exists()] == []


def test_the_teachers_answers_are_kept_and_used_again(
    distilled: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Offline, in a run that is resumed."""
    monkeypatch.chdir(distilled)
    (offline,) = commands(DOCS / "recipes" / "offline.md")
    run_here(*quick(offline), "--output_dir=outputs/twice")
    kept = list((distilled / "outputs" / "twice" / "teacher_chunks").glob("*/*.npy"))
    assert kept
    for path in kept:
        path.touch()
    times = {path: path.stat().st_mtime_ns for path in kept}
    checkpoint = "outputs/twice/checkpoints/last/pretrained_model/train_config.json"
    run_here("lerobot-train", f"--config_path={checkpoint}", "--resume=true", "--steps=6")
    assert {path: path.stat().st_mtime_ns for path in kept} == times, "the teacher was asked again"


def test_the_tutorial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From nothing."""
    shutil.copytree(EXAMPLES / "presets", tmp_path / "examples" / "presets")
    monkeypatch.chdir(tmp_path)
    run_page(TUTORIAL)
    assert (tmp_path / "outputs" / "report" / "report.html").is_file()


def test_the_first_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On clumsy demonstrations of the same task, since the Hub's are not there."""
    demos = record(tmp_path / "demos", pixels=False)
    monkeypatch.chdir(tmp_path)
    data = [f"--dataset.root={demos}", "--dataset.repo_id=local/pusht", "--dataset.episodes=[0,1]"]
    network = ["--policy.down_dims=[16,32]", "--policy.horizon=16", "--policy.n_action_steps=8"]
    teacher = [
        *network,
        "--policy.drop_n_last_frames=7",
        "--policy.num_train_timesteps=4",
        "--policy.device=cpu",
    ]
    student = [*SIZES["student_cpu"], *(f"--policy.collect.{flag}" for flag in ROUNDS), "--policy.device=cpu"]
    make, *shown = commands(README)
    assert make == ["make", "quickstart"]
    for words, more in zip(
        shown,
        ([*LOOP, *data, *teacher], [*LOOP, *data, *student, *SHORT], QUICK["lerobot-eval"]),
        strict=True,
    ):
        run_here(*words, *more)
