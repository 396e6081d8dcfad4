"""Faults of environments, in the one of faulty_point.py."""

from fault import Bench, Fault

from lerobot_agpd.replay.journal import EpisodeJournal


def environment(fault: str, episodes: list[int], *more: str):
    """A new run in the faulty environment."""
    flags = (f"--env.fault={fault}", f"--env.episodes={episodes}".replace(" ", ""), *more)
    return lambda bench: bench.begin("--env.type=faulty_point", *flags)


ALL = list(range(100))
WORKERS = "--policy.collect.use_async_envs=true"

ENVIRONMENTS = [
    Fault(
        "NaN in an observation of one episode",
        environment("nan_state", [2]),
        "dropped",
        ("episodes are dropped", "'observation.state' at step 2 is not finite", "--env.*"),
        "the episode is kept, all 48 tensors of the student become NaN, exit 0",
    ),
    Fault(
        "NaN in a reward of one episode",
        environment("nan_reward", [2]),
        "dropped",
        ("episodes are dropped", "'next.reward' at step 1 is not finite", "--env.*"),
        "a TypeError in the report blocks the round and every resume",
    ),
    Fault(
        "NaN in the observations of all episodes",
        environment("nan_state", ALL),
        "stopped",
        ("4 of 4 episodes are dropped", "'observation.state'", "--env.*", "--resume=true"),
        "",
    ),
    Fault(
        "an environment in a worker process hangs",
        environment("hangs", [2], WORKERS, "--policy.collect.step_timeout=2"),
        "dropped",
        ("no answer from the environment in 2 s", "--policy.collect.step_timeout"),
        "the run waits for ever, without a word",
    ),
    Fault(
        "an environment in the run's own process is slow",
        environment("slow", [2], "--policy.collect.step_timeout=1"),
        "warned",
        ("--policy.collect.step_timeout", "The round waits", WORKERS),
        "the run waits, without a word",
    ),
    Fault(
        "a worker process dies",
        environment("dies", [2], WORKERS),
        "dropped",
        ("worker process has ended", "dropped"),
        "",
    ),
    Fault(
        "an episode never ends",
        environment("never_ends", ALL, "--policy.collect.max_episode_steps=30"),
        "warned",
        ("cut off after 30 steps", "--policy.collect.max_episode_steps"),
        "the run waits for ever, without a word",
    ),
    Fault(
        "success at the first step",
        environment("at_once", ALL),
        "warned",
        ("all 4 were solved at the start", "at its first step"),
        "the warning blames a weak teacher",
    ),
    Fault(
        "never a success",
        environment("never", ALL),
        "warned",
        ("kept no episode", "--policy.collect.min_reward"),
        "guidance grows from round to round",
        afterwards=lambda bench: _strength_grew(bench),
    ),
]


def _strength_grew(bench: Bench) -> list[str]:
    reports = EpisodeJournal(bench.output / "agpd").reports()
    grew = any(report["next_strength"] > report["strength"] for report in reports)
    return ["the strength of guidance has grown"] if grew else []
