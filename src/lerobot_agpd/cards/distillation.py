"""What a model card says of a policy that AGPD has distilled."""

from __future__ import annotations

from pathlib import Path

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_agpd.agpd import AGPD
from lerobot_agpd.cards.model_card import ModelFacts
from lerobot_agpd.config import StudentConfig
from lerobot_agpd.rollout.report import RoundReport, Tally

KINDS = {"agpd": "ACT", "agpd_diffusion": "diffusion"}
"""`--policy.type` to the policy of LeRobot that acts."""

STRATEGIES = {
    "guided": "the teacher, guided toward the student (AGPD)",
    "nearest": "the sample of the teacher that was nearest to the student's chunk",
    "teacher": "the teacher alone (PD)",
    "mixing": "teacher and student, their actions mixed (DAgger)",
    "rollin": "the student, then the guided teacher",
}
"""`collect.strategy` to who acts."""

COLLECTED = """\
A frozen teacher acted in simulation, the episodes that succeeded joined the demonstrations, and the policy imitated both
(*Adaptive Guidance Policy Distillation*, AGPD). It needs neither teacher nor dataset to act."""

SELF_TAUGHT = """\
In every collection round it acted in simulation, guided toward what it had been a round before. The episodes that succeeded
joined the demonstrations, and it imitated both (self-distillation by *Adaptive Guidance Policy Distillation*, AGPD)."""

OFFLINE = """\
It was distilled from a frozen teacher at the states of the demonstrations. It needs neither teacher nor dataset to act."""

CLONED = "It imitates demonstrations."


def distillation_facts(agpd: AGPD, n_parameters: int, dataset: LeRobotDatasetMetadata) -> ModelFacts:
    """What a card says of a student.

    Args:
        agpd: what trains it.
        n_parameters: of the network that acts.
        dataset: the demonstrations.
    """
    config, progress = agpd.config, agpd.progress
    teacher = config.teacher.path
    on_hub = bool(teacher) and not Path(teacher).exists()
    seen = len(agpd.replay.seen_episodes)
    facts = {
        "teacher": _teacher(config),
        "demonstrations": f"`{dataset.repo_id}`: {seen} of {dataset.total_episodes} episodes, {dataset.fps} fps",
        **_collection(config, agpd.reports),
        "parameters that act": f"{n_parameters / 1e6:.2f} M",
        "chunk": f"{config.predicted_steps} steps predicted, {config.n_execute} executed",
        "training steps": f"{progress.step} of {agpd.run.steps or 'unknown'}",
    }
    kind = KINDS.get(config.type, config.type)
    if config.collect.enabled:
        explanation = COLLECTED if teacher else SELF_TAUGHT
    else:
        explanation = OFFLINE if config.uses_teacher else CLONED
    if config.collect.keep_failures:
        explanation = explanation.replace("episodes that succeeded", "episodes")
    article = "An" if kind[0] in "AEIOU" else "A"
    return ModelFacts(
        summary=f"{article} {kind} policy for [LeRobot](https://github.com/huggingface/lerobot). {explanation}",
        facts=facts,
        dataset=dataset.repo_id,
        base_model=teacher if on_hub else None,
        env=config.collect.env or agpd.run.env,
        sections=_rounds(agpd.reports),
        resumed=agpd.run.resume,
    )


def _teacher(config: StudentConfig) -> str:
    if not config.uses_teacher:
        return "none: the demonstrations were cloned"
    if not config.teacher.path:
        return "the student itself, after the round before"
    settings = [
        f"{config.teacher.num_inference_steps} denoising steps" if config.teacher.num_inference_steps else "",
        config.teacher.noise_scheduler or "",
    ]
    return ", ".join([f"`{config.teacher.path}`", *filter(None, settings)])


def _collection(config: StudentConfig, reports: list[RoundReport]) -> dict[str, str]:
    if not config.collect.enabled:
        relabel = config.replay.relabel
        return {} if relabel == "none" else {"imitated": f"the teacher's own chunks (`relabel={relabel}`)"}
    totals = [report.total for report in reports]
    generated, kept = (sum(getattr(total, name) for total in totals) for name in ("generated", "kept"))
    return {
        "who acted while collecting": STRATEGIES[config.collect.strategy],
        "collection rounds": f"{len(reports)}: {generated} episodes generated, {kept} kept",
        "weight of the adversary": f"{config.adversary.weight:g}",
    }


def _rounds(reports: list[RoundReport]) -> list[str]:
    """A table with a row per round."""
    if not reports:
        return []
    header = "| round | after step | strength | strategy | teacher alone | kept |\n" + "| --- " * 6 + "|"
    rows = [
        f"| {report.round} | {report.step} | {report.strength:.3g} | {_successes(report.strategy)} | "
        f"{_successes(report.teacher_only)} | {report.total.kept} of {report.total.generated} |"
        for report in reports
    ]
    note = "Successes of the episodes that the strategy decided, and of those of the teacher alone:"
    return ["\n".join(["## Collection rounds", "", note, "", header, *rows])]


def _successes(tally: Tally) -> str:
    return f"{tally.successful} of {tally.counted}" if tally.counted else "-"
