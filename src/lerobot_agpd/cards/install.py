"""How to install this plugin as it is installed here, for those who download what it made."""

from __future__ import annotations

import json
from importlib.metadata import PackageNotFoundError, distribution

DISTRIBUTION = "lerobot_policy_agpd"
UNKNOWN = "<URL of the repository of lerobot_policy_agpd>"


def install_command(extras: str = "") -> str:
    """The `pip install` line of this version, in git's form.

    An installation from git knows its URL and commit (PEP 610). One from a folder knows neither; its project's URL
    stands in if the package declares one.

    Args:
        extras: e.g. `pusht`.
    """
    name = f"{DISTRIBUTION}[{extras}]" if extras else DISTRIBUTION
    return f'pip install "{name} @ git+{_git_url()}"'


def _git_url() -> str:
    try:
        installed = distribution(DISTRIBUTION)
    except PackageNotFoundError:
        return UNKNOWN
    origin = json.loads(installed.read_text("direct_url.json") or "{}")
    if commit := origin.get("vcs_info", {}).get("commit_id"):
        return f"{origin['url']}@{commit}"
    urls = (entry.split(", ", 1) for entry in installed.metadata.get_all("Project-URL") or ())
    return next((url for label, url in urls if label.lower() in ("repository", "source")), UNKNOWN)
