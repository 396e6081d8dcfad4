"""With what a number was made: packages, code, machine."""

from __future__ import annotations

import os
import platform
import subprocess
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

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
    """Versions of what is installed, the commit of this package's checkout (None outside of one), the host."""
    return {
        "versions": {"python": platform.python_version(), **_versions()},
        "git": _commit(Path(lerobot_agpd.__file__)),
        "host": {
            "name": platform.node(),
            "system": platform.platform(),
            "cpu": _cpu(),
            "cores": os.cpu_count(),
        },
    }


def _versions() -> dict[str, str]:
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _commit(file: Path) -> dict[str, Any] | None:
    def git(*words: str) -> str:
        command = ["git", "-C", str(file.parent), *words]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    try:
        git("ls-files", "--error-unmatch", file.name)  # an installed copy may lie inside another repository
        return {"commit": git("rev-parse", "HEAD"), "modified": bool(git("status", "--porcelain"))}
    except (OSError, subprocess.CalledProcessError):
        return None


def _cpu() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor()
