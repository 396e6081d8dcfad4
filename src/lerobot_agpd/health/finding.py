"""What an examination has found, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum


class Severity(StrEnum):
    """How bad a finding is, mildest first."""

    OK = "ok"
    NOTE = "note"
    """Worth knowing; nothing is wrong."""
    WARNING = "warning"
    """Something will not work as most people expect."""
    BROKEN = "broken"
    """Something does not work, or is lost."""


@dataclass(frozen=True)
class Finding:
    """One fact.

    Attributes:
        severity: how bad it is.
        area: what it is about, such as `rendering`.
        text: one line; of a file it names the path.
        remedy: one line, what to do; empty if nothing is to be done.
    """

    severity: Severity
    area: str
    text: str
    remedy: str = ""

    @classmethod
    def of(cls, severity: Severity, area: str, error: object, remedy: str = "") -> Finding:
        """A finding in the words of an error, whose message says after a semicolon what to do; else `remedy`."""
        text, _, advice = " ".join(str(error).split()).partition("; ")
        return cls(severity, area, text, advice or remedy)


def is_broken(findings: Iterable[Finding]) -> bool:
    """Whether anything is broken."""
    return any(finding.severity is Severity.BROKEN for finding in findings)
