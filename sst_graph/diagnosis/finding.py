"""A likely fault in the data, as one sentence."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """A likely cause.

    Attributes:
        cause: the likely fault.
        evidence: for it, with numbers.
        check: what to inspect or change.
    """

    cause: str
    evidence: str
    check: str

    @property
    def sentence(self) -> str:
        return f"{self.cause} ({self.evidence}): {self.check}"
