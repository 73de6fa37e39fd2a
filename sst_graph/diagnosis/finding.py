"""What is probably wrong with the data, in one sentence."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """A likely cause.

    Attributes:
        cause: what is probably wrong.
        evidence: what says so, with numbers.
        check: what to look at or change.
    """

    cause: str
    evidence: str
    check: str

    @property
    def sentence(self) -> str:
        return f"{self.cause} ({self.evidence}): {self.check}"
