"""Reasons of a result in one short line each: what is wrong, and what to do about it.

A reason is a sentence of clauses, "what: figures; remedy". A terminal shows a long one by its first and its
last clause, in shorter phrases where these are too long; the report shows all. Behind a likely cause of the
data the other reasons, most of them its consequences, are counted only.
"""

from __future__ import annotations

import re

from sst_graph.errors import count_of
from sst_graph.result import LIKELY_CAUSES, CalibrationResult

MOST_LETTERS = 160
"""Letters of a short reason: two lines of a terminal."""
MOST_REASONS = 5
"""Reasons on a terminal: the first is the most important one."""
_PARENTHESES = re.compile(r" ?\([^()]*\)")
_BREAK = re.compile(r":\s+")
_ASIDES = re.compile(r"; it is in the sigmas$|; by edges: .*$")
"""What a long reason is shown without: a consequence, or the same of another method."""
_NAME = re.compile(r"\S+|drive '[^']*'|by labels|(the motion was|labels were|edges were) left out")
"""A first clause that says which part of the data or of the method the next one is about."""

_SHORTER = (
    # Parts of drives that contradict each other.
    (r"(frames \d+ to \d+) and (those from \d+ on|the others) contradict each other", r"\1 contradict \2"),
    (r"an image or a scan was lost", "a frame was lost"),
    (r", and calibrate the frames before and after apart", ", and calibrate both apart"),
    (
        r"check whether .*, and calibrate both apart",
        "check the mount, lost frames and clocks, and calibrate both apart",
    ),
    (r"check whether the mount was moved or a clock was set between them", "check the mount and the clocks"),
    # Sweeps and stamps.
    (
        r"the scans do not show whether they are compensated, and it matters",
        "the scans may be compensated or not",
    ),
    (
        r"the times of the points say (\w+)(, [^,]+ a turn)?, the scans",
        r"the points' times say \1, the scans",
    ),
    (r", which leaves them out", ""),
    (r"the scans are not as --sweep (\w+) says, but", r"the scans are not \1, but"),
    (r" against their own interval", ""),
    (
        r"calibrate the frames before and from there apart, or use (.*) if the sensor has no steady rate",
        r"calibrate before and after apart, or use \1",
    ),
    (r", but by .* the time offset is the same before and after it", ", but not the time offset"),
    (
        r"the stamps are right, and the sensor has paused, or frames were picked from a faster one",
        "the sensor has paused, or frames were picked",
    ),
    (r", or scans too far apart in time leave the motion between them open", ", or scans are far apart"),
    (
        r"stamp images by their trigger or exposure, not by their arrival, and scan",
        "stamp images by their trigger, and scan",
    ),
    (r"the pictures shift against the cloud from image to image", "the pictures shift from image to image"),
    # Methods.
    (r"(the motion was left out, for it contradicts the labels of .*?): it differs from them in .*", r"\1"),
    (r"compare the class numbers of the labels with", "compare the class numbers with"),
    # Directions that are weak.
    (r" of the LiDAR's frame", ""),
    (r" cannot be distinguished from", " cannot be told from"),
    (r"by static objects alone, ", ""),
)
"""Patterns of phrases, and what stands in their place, one after the other, in a reason that is too long."""


def short_reasons(result: CalibrationResult) -> tuple[str, ...]:
    """Each reason of a result as one short line, the most important first."""
    return tuple(dict.fromkeys(map(short_reason, result.reasons)))


def leading_in_full(result: CalibrationResult) -> tuple[str, ...]:
    """The likely causes in the data, and then what else stands before the last of them, such as what a rig's
    cameras contradict; all reasons where no cause is known."""
    reasons, stored = result.reasons, result.diagnostics.get(LIKELY_CAUSES)
    causes = [one for one in reasons if one in stored] if isinstance(stored, list) else []
    if not causes:
        return reasons
    last = max(position for position, one in enumerate(reasons) if one in causes)
    return tuple(dict.fromkeys([*causes, *reasons[:last]]))


def leading_reasons(result: CalibrationResult) -> tuple[tuple[str, ...], str]:
    """Short reasons that are shown one by one, and a line about all others, where a likely cause in the data
    is known: it leaves them little to say, and their remedies mislead."""
    leading = tuple(dict.fromkeys(map(short_reason, leading_in_full(result))))
    others = len(short_reasons(result)) - len(leading)
    if not others:
        return leading, ""
    which = "a consequence of" if others == 1 else "mostly consequences of"
    return leading, f"{count_of(others, 'more reason')}, {which} {'it' if len(leading) == 1 else 'them'}"


def first_reason(result: CalibrationResult, report: str, summary: bool = False) -> str:
    """The first reason, and how many more there are and where, in one line.

    Args:
        report: what has all of them, such as "the report".
        summary: whether there is a summary, too, which has the first few.
    """
    leading, consequences = leading_reasons(result)
    first, *others = leading or ("the result carries no reason",)
    summary = summary and 0 < len(others) < MOST_REASONS
    counts = [f"{len(others)} more" + " in the summary" * summary] if others else []
    if consequences:
        return f"{first} ({' and '.join([*counts, consequences])}; in {report})"
    return first + "".join(f" ({one}{'; in full' * summary} in {report})" for one in counts)


def short_reason(reason: str) -> str:
    """What is wrong and what to do: without what stands in parentheses, and, of a long sentence, between."""
    whole = _PARENTHESES.sub("", " ".join(reason.split()).rstrip("."))
    if len(whole) <= MOST_LETTERS:
        return whole
    whole = _ASIDES.sub("", whole)
    short = _what_and_remedy(whole)
    for pattern, shorter in _SHORTER:
        if sum(map(len, short)) <= MOST_LETTERS:
            break
        whole = re.sub(pattern, shorter, whole)
        short = _what_and_remedy(whole)
    what, remedy = short
    if len(what) + len(remedy) <= MOST_LETTERS:
        return what + remedy
    what = cut(what, max(MOST_LETTERS - len(remedy), MOST_LETTERS // 2))
    return what + cut(remedy, MOST_LETTERS - len(what))


def _what_and_remedy(whole: str) -> tuple[str, str]:
    """A reason that is short; else its first and its last clause, the latter with the colon before it."""
    if len(whole) <= MOST_LETTERS:
        return whole, ""
    clauses = [clause.strip() for clause in _BREAK.split(whole)]
    name = f"{clauses.pop(0)}: " if len(clauses) > 1 and _NAME.fullmatch(clauses[0]) else ""
    what, *rest = clauses
    what = name + what.split(";")[0].strip()
    return what, f": {rest[-1].split(';')[-1].strip()}" if rest else ""


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
