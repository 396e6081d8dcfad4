"""A stranger's checkpoint runs nothing: not by its processor files, its weights or its settings, on any way in."""

import json
import pickle
import sys
from pathlib import Path

import pytest
from lerobot.policies import make_pre_post_processors
from lerobot.policies.pi0_fast.configuration_pi0_fast import PI0FastConfig
from tiny_policies import ACT, WITH_CAMERA, make_policy

from lerobot_agpd.config import TeacherConfig
from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.loading import load_policy, load_teacher, read_policy_config
from lerobot_agpd.replay.normalization import saved_statistics
from lerobot_agpd.trust import PROCESSOR_FILES, admitted_packages, check_steps, require_known_policy

PAYLOAD = """
from pathlib import Path

MARKER = Path(__file__).with_name("imported")
MARKER.touch()

def run(**arguments):
    Path(__file__).with_name("called").touch()
"""


@pytest.fixture
def checkpoint(tmp_path) -> Path:
    """A harmless checkpoint of ACT."""
    folder = tmp_path / "checkpoint"
    for part in make_policy("act", WITH_CAMERA, **ACT):
        part.save_pretrained(folder)
    return folder


@pytest.fixture
def payload(tmp_path, monkeypatch):
    """A program that leaves a marker when it is imported, and one when it is called; tells what it left."""
    folder = tmp_path / "programs"
    folder.mkdir()
    (folder / "agpd_payload.py").write_text(PAYLOAD)
    monkeypatch.syspath_prepend(folder)
    yield lambda: sorted(path.name for path in folder.iterdir() if not path.name.endswith((".py", "__")))
    sys.modules.pop("agpd_payload", None)


def add_step(checkpoint: Path, name: str, **entry) -> Path:
    """Put a step in front of a processor file of a checkpoint."""
    file = checkpoint / name
    content = json.loads(file.read_text())
    content["steps"].insert(0, {"config": {}, **entry})
    file.write_text(json.dumps(content))
    return file


def test_lerobots_own_loader_runs_it(checkpoint, payload):
    """What this is about; once LeRobot refuses it itself, the check can go."""
    add_step(checkpoint, PROCESSOR_FILES[0], **{"class": "agpd_payload.run"})
    with pytest.raises(TypeError, match="must inherit from ProcessorStep"):  # what it returned; it has run
        make_pre_post_processors(read_policy_config(checkpoint, "--flag"), pretrained_path=str(checkpoint))
    assert payload() == ["called", "imported"]


@pytest.mark.parametrize("name", PROCESSOR_FILES)
@pytest.mark.parametrize("way", ["teacher", "policy", "statistics"])
def test_a_program_in_a_processor_file(checkpoint, payload, name, way):
    file = add_step(checkpoint, name, **{"class": "agpd_payload.run"})
    with pytest.raises(FlagError, match="step 0: 'agpd_payload.run' is no processor step") as refused:
        if way == "teacher":
            load_teacher(TeacherConfig(path=str(checkpoint)), "cpu")
        else:
            config = read_policy_config(checkpoint, "--policy.path")
            load_policy(config) if way == "policy" else saved_statistics(checkpoint, config)
    assert str(file) in str(refused.value) and "\n" not in str(refused.value)
    assert payload() == []


@pytest.mark.parametrize(
    "entry",
    [
        {"class": "subprocess.Popen", "config": {"args": ["true"]}},
        {"class": "lerobot.processor.pipeline.importlib.import_module"},  # a module behind one of LeRobot's
        {"class": "lerobot.processor.pipeline.hf_hub_download"},  # of LeRobot, and no step
        {"class": "lerobot.policies.act.modeling_act.ACTPolicy"},
        {"class": "lerobot.no_such_module.Step"},
        {"class": "lerobot_policy_not_installed.Step"},
        {"class": "Popen"},
        {"class": ".relative.Step"},
        {"class": None},
        {"registry_name": "not_registered"},
        {"registry_name": "not_registered", "class": "lerobot.processor.RenameObservationsProcessorStep"},
        {"registry_name": ["rename_observations_processor"]},
        {},
    ],
    ids=str,
)
def test_what_is_no_processor_step(checkpoint, entry):
    file = add_step(checkpoint, PROCESSOR_FILES[0], **entry)
    with pytest.raises(FlagError, match="step 0: .* is no processor step"):
        check_steps(file)


@pytest.mark.parametrize(
    "entry",
    [
        {"registry_name": "rename_observations_processor"},
        {"class": "lerobot.processor.RenameObservationsProcessorStep"},
    ],
    ids=str,
)
def test_steps_of_lerobot_are_built(checkpoint, entry):
    add_step(checkpoint, PROCESSOR_FILES[0], **entry)
    steps = load_policy(read_policy_config(checkpoint, "--policy.path")).preprocessor.steps
    assert type(steps[0]).__name__ == "RenameObservationsProcessorStep"


def test_steps_of_an_installed_plugin_are_built(checkpoint, tmp_path, monkeypatch):
    site = tmp_path / "site-packages"
    metadata = site / "lerobot_policy_agpd_stranger-1.0.dist-info" / "METADATA"
    metadata.parent.mkdir(parents=True)
    metadata.write_text("Metadata-Version: 2.1\nName: lerobot_policy_agpd_stranger\nVersion: 1.0\n")
    source = "from lerobot.processor import IdentityProcessorStep\nclass Step(IdentityProcessorStep): pass\n"
    (site / "lerobot_policy_agpd_stranger.py").write_text(source)
    file = add_step(checkpoint, PROCESSOR_FILES[0], **{"class": "lerobot_policy_agpd_stranger.Step"})
    with pytest.raises(FlagError, match="is no processor step"):
        check_steps(file)
    monkeypatch.syspath_prepend(site)
    assert "lerobot_policy_agpd_stranger" in admitted_packages()
    assert len(load_policy(read_policy_config(checkpoint, "--policy.path")).preprocessor.steps) == 5


def test_code_of_a_hub_repository_behind_a_step_of_lerobot(checkpoint):
    """The step loads a tokenizer with `trust_remote_code=True` by default."""
    chosen = {"action_tokenizer_name": "stranger/tokenizer"}
    step = "action_tokenizer_processor"
    file = add_step(checkpoint, PROCESSOR_FILES[0], registry_name=step, config=chosen)
    with pytest.raises(FlagError, match="action_tokenizer_name='stranger/tokenizer' names a Hub repository"):
        check_steps(file)


def test_code_of_a_hub_repository_behind_a_policy():
    require_known_policy(PI0FastConfig(device="cpu"), "checkpoint")
    chosen = PI0FastConfig(device="cpu", text_tokenizer_name="stranger/tokenizer")
    with pytest.raises(FlagError, match="checkpoint/config.json: text_tokenizer_name='stranger/tokenizer'"):
        require_known_policy(chosen, "checkpoint")


def test_a_hub_repository_is_checked_at_the_commit_that_is_built(checkpoint, payload, tmp_path, monkeypatch):
    """The cache of a repository as the Hub's client lays it out: its main branch is the harmless commit."""
    cache = tmp_path / "hub"
    repository = cache / "models--stranger--teacher"
    for commit, branch in (("a" * 40, "main"), ("b" * 40, "bad")):
        snapshot = repository / "snapshots" / commit
        snapshot.parent.mkdir(parents=True, exist_ok=True)
        snapshot.symlink_to(checkpoint) if branch == "main" else copy(checkpoint, snapshot)
        (repository / "refs").mkdir(exist_ok=True)
        (repository / "refs" / branch).write_text(commit)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(cache))
    add_step(repository / "snapshots" / ("b" * 40), PROCESSOR_FILES[1], **{"class": "agpd_payload.run"})
    config = read_policy_config("stranger/teacher", "--policy.teacher.path")
    assert saved_statistics("stranger/teacher", config)
    config.pretrained_revision = "bad"
    with pytest.raises(FlagError, match=f"{'b' * 40}/policy_postprocessor.json, step 0: 'agpd_payload.run'"):
        load_policy(config)
    assert payload() == []


def copy(source: Path, target: Path) -> None:
    target.mkdir()
    for path in source.iterdir():
        (target / path.name).write_bytes(path.read_bytes())


class Program:
    """Runs when it is unpickled."""

    def __init__(self, marker: Path):
        self.marker = marker

    def __reduce__(self):
        return Path.touch, (self.marker,)


@pytest.mark.parametrize("name", ["pytorch_model.bin", "model.pt", "model.safetensors"])
def test_pickled_weights_are_never_read(checkpoint, tmp_path, name):
    (checkpoint / "model.safetensors").unlink()
    (checkpoint / name).write_bytes(pickle.dumps(Program(tmp_path / "marker")))
    with pytest.raises(ValueError, match=f"{checkpoint}/model.safetensors") as refused:
        load_teacher(TeacherConfig(path=str(checkpoint)), "cpu")
    assert name in str(refused.value) and not (tmp_path / "marker").exists()


# ---- damaged files of a checkpoint ----


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize(
    "pattern",
    [
        "config.json",
        "model.safetensors",
        "policy_preprocessor.json",
        "policy_postprocessor.json",
        "policy_preprocessor_step_*_normalizer_processor.safetensors",
        "policy_postprocessor_step_*_unnormalizer_processor.safetensors",
    ],
)
@pytest.mark.parametrize("damage", [truncate, Path.unlink])
def test_a_damaged_or_missing_file_of_a_teacher_is_named(checkpoint, pattern, damage):
    (file,) = checkpoint.glob(pattern)
    damage(file)
    with pytest.raises((ValueError, FlagError, FileNotFoundError)) as refused:
        load_teacher(TeacherConfig(path=str(checkpoint)), "cpu")
    message = str(refused.value)
    assert "\n" not in message and (file.name in message) and str(checkpoint) in message
    assert damage is Path.unlink or "restore the file" in message


def test_a_checkpoint_without_processor_files_names_the_migration(checkpoint):
    (checkpoint / PROCESSOR_FILES[0]).unlink()
    with pytest.raises(FlagError, match="python -m lerobot.processor.migrate_policy_normalization"):
        load_teacher(TeacherConfig(path=str(checkpoint)), "cpu")


def test_a_run_folder_given_as_teacher(checkpoint, tmp_path):
    folder = tmp_path / "run" / "checkpoints" / "last" / "pretrained_model"
    folder.parent.mkdir(parents=True)
    checkpoint.rename(folder)
    for path in (tmp_path / "run", tmp_path / "run" / "checkpoints"):
        with pytest.raises(FileNotFoundError, match=f"did you mean '{folder}'"):
            load_teacher(TeacherConfig(path=str(path)), "cpu")


def test_a_teacher_with_a_setting_of_another_version(checkpoint):
    file = checkpoint / "config.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "of_tomorrow": 1}))
    with pytest.raises(FlagError, match="--policy.teacher.path=.* another version .*`of_tomorrow`"):
        load_teacher(TeacherConfig(path=str(checkpoint)), "cpu")
