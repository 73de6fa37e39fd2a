"""The normal equations of any graph whose only motion are the twists of single images, by gtsam."""

from __future__ import annotations

import gtsam
import numpy as np

from sst_graph.graph.elimination import NormalEquations, Unknowns
from sst_graph.graph.linear import ordering_of
from sst_graph.graph.state import EXTRINSIC

_ORDER = "EDNBO"
"""Letters of the unknowns' keys, in the order of their columns."""


def unknowns_of(graph: gtsam.NonlinearFactorGraph) -> Unknowns:
    """All but the twists, ordered as in a frozen problem."""
    keys = [key for key in graph.keyVector() if chr(gtsam.symbolChr(key)) in _ORDER]
    unknowns = Unknowns(tuple(sorted(keys, key=lambda key: (_ORDER.index(chr(gtsam.symbolChr(key))), key))))
    assert unknowns.keys[0] == EXTRINSIC
    return unknowns


def system_of(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> NormalEquations:
    """The graph linearized at some values."""
    unknowns = unknowns_of(graph)
    twists = sorted(set(graph.keyVector()) - set(unknowns.keys))
    whole, b = graph.linearize(values).hessian(ordering_of((*unknowns.keys, *twists)))
    n, f = unknowns.size, len(twists)
    mixed = whole[n:, :n].reshape(f, 6, n)
    blocks = whole[n:, n:].reshape(f, 6, f, 6)
    of_twists = np.array([blocks[k, :, k] for k in range(f)]).reshape(f, 6, 6)
    g = -np.asarray(b).reshape(-1)
    between = blocks.copy()
    between[range(f), :, range(f)] = 0.0
    assert not between.any(), "a factor on two twists"
    g_twists = g[n:].reshape(f, 6)
    return NormalEquations(
        unknowns, tuple(twists), graph.error(values), whole[:n, :n], g[:n], of_twists, g_twists, mixed
    )
