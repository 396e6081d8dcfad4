"""What a number was made with: packages, code, machine, and the files that a training started from."""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
from collections.abc import Mapping
from functools import cache
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from lerobot.datasets.utils import STATS_PATH

import lerobot_agpd

PACKAGES = (
    "lerobot",
    "lerobot_policy_agpd",
    "torch",
    "numpy",
    "diffusers",
    "gymnasium",
    "gymnasium-robotics",
    "gym-pusht",
    "gym-aloha",
    "mujoco",
)


@cache
def provenance() -> dict[str, Any]:
    """Versions of the installed packages, the commit of this package's checkout (None outside of one), the host."""
    packages = {entry.name: entry.version for entry in distributions() if entry.name in PACKAGES}
    return {
        "versions": {"python": platform.python_version(), **packages},
        "git": _commit(Path(lerobot_agpd.__file__)),
        "host": {
            "name": platform.node(),
            "system": platform.platform(),
            "cpu": _cpu(),
            "cores": os.cpu_count(),
        },
    }


def digest(path: str | Path) -> str:
    """SHA-256 of a checkpoint's weights; the name of a Hub repository."""
    return _sha256(Path(path) / SAFETENSORS_SINGLE_FILE) or str(path)


def inputs(flags: Mapping[str, Any]) -> dict[str, str]:
    """Fingerprint the files that a training starts from: a path does not say which files lie there.

    Args:
        flags: dotted flags of lerobot-train.

    Returns:
        `teacher`, of its weights, if the run has one; `demonstrations`, of their statistics, if they are on this
        machine.
    """
    fingerprints: dict[str, str] = {}
    if teacher := flags.get("policy.teacher.path"):
        fingerprints["teacher"] = digest(teacher)
    root = flags.get("dataset.root")
    if root and (statistics := _sha256(Path(root) / STATS_PATH)):
        fingerprints["demonstrations"] = statistics
    return fingerprints


def _sha256(path: Path) -> str | None:
    if not path.is_file():
        return None
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _commit(file: Path) -> dict[str, Any] | None:
    def git(*args: str) -> str:
        command = ["git", "-C", str(file.parent), *args]
        done = subprocess.run(command, capture_output=True, text=True, check=True)  # noqa: S603  # no shell
        return done.stdout.strip()

    try:
        git("ls-files", "--error-unmatch", file.name)  # an installed copy may lie inside another repository
        return {"commit": git("rev-parse", "HEAD"), "modified": bool(git("status", "--porcelain"))}
    except (OSError, subprocess.CalledProcessError):
        return None


def _cpu() -> str:
    info = Path("/proc/cpuinfo")
    for line in info.read_text().splitlines() if info.is_file() else ():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor()
