"""Packages that optional extras install."""

import importlib
from collections.abc import Sequence


def require_packages(names: Sequence[str], user: str, extra: str) -> None:
    """Import packages that an optional extra installs.

    Args:
        names: packages; importing them registers their environments.
        user: what needs them, for the message.
        extra: name of the extra.

    Raises:
        ModuleNotFoundError: naming the extra, if one of them or one of their requirements is not installed.
    """
    try:
        for name in names:
            importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{user} needs the package {error.name!r}, which is not installed. "
            f"Run: pip install 'lerobot_policy_agpd[{extra}]'",
            name=error.name,
        ) from error
