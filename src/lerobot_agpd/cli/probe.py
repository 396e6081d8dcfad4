"""`lerobot-agpd-probe`: is this teacher one that guidance can help with? A verdict, a picture and JSON."""

import logging
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import draccus
from lerobot.configs import PreTrainedConfig, parser
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs import EnvConfig
from rich.console import Console

from lerobot_agpd.cli.command import entry_point, machine_device
from lerobot_agpd.config import EVALUATION_SEEDS, TeacherConfig
from lerobot_agpd.files import write_json
from lerobot_agpd.fit import check_fit, check_teacher
from lerobot_agpd.flag_checks import require
from lerobot_agpd.loading import load_student, load_teacher, read_policy_config, require_student
from lerobot_agpd.studies.evaluation import Evaluator
from lerobot_agpd.studies.probe import TeacherProbe
from lerobot_agpd.studies.probe_picture import draw_probe
from lerobot_agpd.studies.probe_states import RecordedStates
from lerobot_agpd.studies.probe_verdict import Verdict, conclude, fewer_steps
from lerobot_agpd.studies.probe_ways import LEAST_MEMBERS
from lerobot_agpd.studies.provenance import provenance
from lerobot_agpd.studies.statistics import success_rate
from lerobot_agpd.studies.tables import Row, console_table

logger = logging.getLogger(__name__)


@dataclass
class DemonstrationsConfig:
    """The demonstrations at whose states the teacher is asked."""

    # LeRobotDataset with what the teacher observes.
    repo_id: str = ""
    # Its folder; default: LeRobot's cache, or the Hub.
    root: Path | None = None

    def read(self) -> LeRobotDatasetMetadata:
        """Read the metadata.

        Raises:
            FileNotFoundError: if there is no such dataset.
        """
        require(
            self.root is None or (self.root / "meta/info.json").is_file(),
            f"--dataset.root={self.root} is not the folder of a LeRobotDataset (it has no meta/info.json)",
        )
        try:
            return LeRobotDatasetMetadata(self.repo_id, root=self.root)
        except Exception as error:  # whatever the Hub's client raises
            raise FileNotFoundError(
                f"--dataset.repo_id={self.repo_id} is neither in LeRobot's cache nor on the Hub, and --dataset.root is "
                f"not set ({type(error).__name__})"
            ) from error


@dataclass
class ProbeConfig:
    """Options of `lerobot-agpd-probe`."""

    # Folder of probe.json and probe.png.
    output: Path
    # The teacher; default: the student's.
    teacher: TeacherConfig = field(default_factory=TeacherConfig)
    # The demonstrations.
    dataset: DemonstrationsConfig = field(default_factory=DemonstrationsConfig)
    # A student toward whose chunks the teacher is pulled: --policy.path=<checkpoint>; default: one more sample of the teacher.
    policy: PreTrainedConfig | None = None
    # Environment for the teacher's success with fewer denoising steps; default: not measured.
    env: EnvConfig | None = None
    # Frames of the demonstrations, and starts of episodes at most.
    states: int = 64
    # Samples of the teacher per state; rare ways need many.
    samples: int = 128
    # Episodes per number of denoising steps, in the environment.
    episodes: int = 100
    # Environments side by side.
    batch_size: int = 50
    # Seed of the choice of states and of the noise.
    seed: int = 0
    # First environment seed; training and collection stay away from 100000 to 999999.
    env_seed: int = EVALUATION_SEEDS[0]
    # Where policies run; default: this machine's accelerator, else the CPU.
    device: str = ""

    def __post_init__(self) -> None:
        """Read the student's configuration, if there is one, and check the options.

        Raises:
            FlagError: if teacher or demonstrations are not named, or a number is out of range.
            FileNotFoundError: if there is no policy where one should be.
        """
        self.device = self.device or machine_device()
        path = parser.get_path_arg("policy")
        if path:
            self.policy = read_policy_config(path, "--policy.path")
        if self.policy is not None:
            student = require_student(self.policy)
            student.device = self.device
            self.teacher.path = self.teacher.path or student.teacher.path
        require(
            bool(self.teacher.path), "--teacher.path is not set: name a checkpoint folder or a Hub repository"
        )
        require(bool(self.dataset.repo_id), "--dataset.repo_id is not set: name the demonstrations")
        for name, least in (
            ("states", 1),
            ("samples", 2 * LEAST_MEMBERS),
            ("episodes", 2),
            ("batch_size", 1),
        ):
            value = getattr(self, name)
            require(value >= least, f"--{name} must be at least {least}, got {value}")
        low, high = EVALUATION_SEEDS
        require(
            low <= self.env_seed and self.env_seed + self.episodes <= high,
            f"--env_seed={self.env_seed}: environments of an evaluation lie in [{low}, {high})",
        )
        read_policy_config(self.teacher.path, "--teacher.path")

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """Fields whose `.path` the parser leaves to `__post_init__`."""
        return ["policy"]


# ---- the parts ----


def make_probe(config: ProbeConfig) -> TeacherProbe:
    """Load teacher, student and demonstrations, and check that they fit."""
    meta = config.dataset.read()
    teacher = load_teacher(config.teacher, config.device)
    check_teacher(teacher, meta, config.env)
    student = None
    if config.policy is not None:
        check_fit(require_student(config.policy), teacher, meta, config.env)
        student = load_student(config.policy)
    dataset = LeRobotDataset(config.dataset.repo_id, root=config.dataset.root)
    states = RecordedStates(dataset, teacher, student, config.states, config.seed)
    return TeacherProbe(teacher, states, config.samples, config.seed, student)


def success_by_steps(config: ProbeConfig, counts: Sequence[int | None]) -> list[dict[str, Any]]:
    """The teacher's success with each number of denoising steps (None: the only way), with Wilson's interval."""
    if config.env is None:
        return []
    rows = []
    n_envs = min(config.batch_size, config.episodes)
    with closing(Evaluator(config.env, n_envs, config.output, config.device)) as evaluator:
        for steps in counts:
            sampler = TeacherConfig(num_inference_steps=steps, noise_scheduler=config.teacher.noise_scheduler)
            path, seed = config.teacher.path, config.env_seed
            evaluation = evaluator.evaluate(path, config.episodes, seed, sampler=sampler)
            rows.append({"steps": steps, **asdict(success_rate(evaluation.successes))})
    return rows


def probe_teacher(config: ProbeConfig) -> tuple[dict[str, Any], Verdict]:
    """Measure everything, write probe.json and probe.png.

    Returns:
        What probe.json holds, and the verdict.
    """
    probe = make_probe(config)
    config.output.mkdir(parents=True, exist_ok=True)
    logger.info("%d samples at each of %d states", config.samples, len(probe.states))
    evidence = probe.evidence(probe.pulls())
    verdict = conclude(evidence)
    latency = probe.latency()
    success = success_by_steps(config, [steps for steps, _ in latency])
    costs = [
        (steps, row["mean"], milliseconds)
        for row, (steps, milliseconds) in zip(success, latency, strict=False)
        if steps is not None
    ]
    if costs:
        verdict = replace(verdict, reasons=[*verdict.reasons, fewer_steps(costs)])
    content = {
        "teacher": {**asdict(config.teacher), "type": probe.teacher.policy.config.type},
        "student": None if config.policy is None else str(config.policy.pretrained_path),
        "dataset": asdict(config.dataset),
        "environment": None if config.env is None else draccus.encode(config.env, EnvConfig),
        "samples": config.samples,
        "seed": config.seed,
        "executed_steps": probe.n_steps,
        "denoising_steps": probe.teacher.n_denoising_steps,
        "evidence": asdict(evidence),
        "verdict": asdict(verdict),
        "latency": [{"steps": steps, "milliseconds": time} for steps, time in latency],
        "success": success,
        "states": probe.rows(),
        "provenance": provenance(),
    }
    write_json(config.output / "probe.json", content, indent=1)
    draw_probe(probe, content, config.output / "probe.png")
    return content, verdict


# ---- the command ----


def pull_table(content: dict[str, Any]) -> list[Row]:
    """How far the teacher can be pulled."""
    header = ("", "strength", "moved to the target", "chooses its way", "off the ways")
    rows: list[Row] = [header]
    for pull in content["evidence"]["pulls"]:
        choice = ("-" if pull[key] is None else f"{pull[key]:.0%}" for key in ("chooses", "off"))
        rows.append((pull["strategy"], f"{pull['strength']:g}", f"{pull['moved']:.0%}", *choice))
    return rows


def cost_table(content: dict[str, Any]) -> list[Row]:
    """What the teacher costs, and how well it does, by denoising steps."""
    rows: list[Row] = [("denoising steps", "ms per chunk", "success")]
    for number, row in enumerate(content["latency"]):
        rate = "-"
        if content["success"]:
            found = content["success"][number]
            rate = f"{found['mean']:.2f} [{found['low']:.2f}, {found['high']:.2f}], N = {found['n']}"
        rows.append((str(row["steps"] or "-"), f"{row['milliseconds']:.1f}", rate))
    return rows


@entry_point("lerobot-agpd-probe")
def main(config: ProbeConfig) -> None:
    """Probe, write and show."""
    content, verdict = probe_teacher(config)
    console = Console()
    console.print(f"spread of the teacher's samples: {content['evidence']['spread']:.3g}")
    console.print(console_table(pull_table(content)))
    console.print(console_table(cost_table(content)))
    for reason in verdict.reasons:
        console.print(reason)
    console.print(verdict.flags, style="bold", soft_wrap=True)
    logger.info("numbers and picture in %s", config.output)


if __name__ == "__main__":
    main()
