"""Reasons of a result in one short line each: what is wrong, and what to do about it.

A reason is a sentence of clauses, "what: figures; remedy". A terminal shows a long one by its first and its
last clause; the report shows all.
"""

from __future__ import annotations

import re

from sst_graph.result import CalibrationResult

MOST_LETTERS = 160
"""Letters of a short reason: two lines of a terminal."""
MOST_REASONS = 5
"""Reasons on a terminal: the first is the likely cause, and what follows mostly its consequences."""
_PARENTHESES = re.compile(r" ?\([^()]*\)")
_BREAK = re.compile(r":\s+")


def short_reasons(result: CalibrationResult) -> tuple[str, ...]:
    """Each reason of a result as one short line, the most important first."""
    return tuple(dict.fromkeys(map(short_reason, result.reasons)))


def short_reason(reason: str) -> str:
    """What is wrong and what to do: without what stands in parentheses, and, of a long sentence, between."""
    whole = _PARENTHESES.sub("", " ".join(reason.split()).rstrip("."))
    if len(whole) <= MOST_LETTERS:
        return whole
    clauses = [clause.strip() for clause in _BREAK.split(whole)]
    name = clauses.pop(0) + ": " if len(clauses) > 1 and " " not in clauses[0] else ""
    what, *rest = clauses
    what = what.split(";")[0].strip()
    if not rest:
        return cut(name + what, MOST_LETTERS)
    remedy = rest[-1].split(";")[-1].strip()
    room = max(MOST_LETTERS - len(remedy) - 2, MOST_LETTERS // 2)
    what = cut(name + what, room)
    return f"{what}: {cut(remedy, MOST_LETTERS - len(what) - 2)}"


def as_sentence(reason: str) -> str:
    """A short reason with its full stop; one that was cut ends as it is."""
    return reason if reason.endswith("…") else f"{reason}."


def capitalized(text: str) -> str:
    """With a capital at its beginning; a name that stands there before a colon stays as it is."""
    first = text.split(" ", 1)[0]
    return text if first.endswith(":") else text[:1].upper() + text[1:]


def cut(text: str, most: int) -> str:
    """A text of so many letters at most, ended at a word where it is longer."""
    if len(text) <= most:
        return text
    return text[: most - 1].rsplit(" ", 1)[0].rstrip(",;: ") + "…"
