"""Whether alignment terms can stand in one graph: of one camera, and none of them twice."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gtsam

from sst_graph.errors import count_of
from sst_graph.factors import FactorError, recipe_of
from sst_graph.factors.arguments import checked_type
from sst_graph.factors.custom.variables import factors_of
from sst_graph.factors.pose_alignment import NAME
from sst_graph.slam.alignment_keys import AlignmentKeys
from sst_graph.slam.alignment_term import AlignmentTerm
from sst_graph.types import SemanticClass


def checked_terms(
    where: str, terms: Any, keys: AlignmentKeys | None = None, earlier: Sequence[AlignmentTerm] = ()
) -> None:
    """Nothing, where they are terms of one camera, each of them once.

    A term that counts twice makes the covariance too small.

    Args:
        keys: of the camera, where it is known.
        earlier: terms that are there already.

    Raises:
        FactorError: they are not.
    """
    what = f"terms of {where}"
    checked_type(what, terms, (list, tuple), "a list of AlignmentTerm")
    measured: set[tuple[int, int, SemanticClass]] = set().union(*(term.measured for term in earlier))
    for term in terms:
        checked_type(what, term, AlignmentTerm, "an AlignmentTerm")
        keys = term.keys if keys is None else keys
        if not keys.is_same_camera(term.keys):
            found = "two extrinsics, time offsets or sets of mask biases"
            raise FactorError(what, found, "terms of one camera, all with its keys")
        if measured & term.measured:
            raise FactorError(what, f"the image of {term.stamp_ns} ns with one scan twice", "each pair once")
        measured |= term.measured


def expect_factors_of(
    where: str, graph: gtsam.NonlinearFactorGraph, keys: AlignmentKeys, factors: Sequence[gtsam.CustomFactor]
) -> None:
    """Nothing, where the alignment factors of the camera in the graph are these, once each.

    Others would count as what is known besides the images, and make the covariance too small.

    Raises:
        FactorError: one of these is missing or there twice, or there is another.
    """
    own, variables = {id(each) for each in factors}, set(keys.variables)
    held = [each for each in factors_of(graph) if isinstance(each, gtsam.CustomFactor)]
    found = [id(each) for each in held if id(each) in own]
    others = [each for each in held if id(each) not in own and variables & set(each.keys())]
    alignments = [each for each in others if (recipe := recipe_of(each)) and recipe.name == NAME]
    if len(found) != len(own) or len(set(found)) != len(own):
        missing = len(own) - len(set(found))
        what = f"{missing} of {count_of(len(own), 'factor')} missing" if missing else "a factor twice"
        raise FactorError(f"graph of {where}", what, "the factor of each match, once")
    if alignments:
        number = count_of(len(alignments), "further alignment factor")
        expected = "those of all terms to be given as terms, and not in the graph"
        raise FactorError(f"graph of {where}", f"{number} of this camera", expected if not own else _OTHERS)


_OTHERS = "the matches of all of them"
