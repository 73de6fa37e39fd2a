"""Alignment terms in iSAM2 and in a fixed-lag smoother: factors swapped as the estimate moves.

At every update the user's factors go in first. Then the terms whose matches have changed (points moved,
stamp + offset in another interval, another kernel) are matched again at the new estimate, and their factors
take the place of the old ones. Kernel, proximal prior and the scale of the information are those of
:mod:`sst_graph.slam.solving`.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import gtsam
import numpy as np

from sst_graph.config import expect_settings
from sst_graph.errors import EstimationError
from sst_graph.factors import FactorError
from sst_graph.factors.arguments import checked_count, checked_number, checked_type
from sst_graph.factors.custom.variables import checked_key, expect_kinds, factors_of, key_name
from sst_graph.slam.alignment_keys import COLUMNS, AlignmentKeys
from sst_graph.slam.alignment_term import AlignmentTerm, TermMatches, TermState
from sst_graph.slam.checked_terms import checked_terms, expect_factors_of
from sst_graph.slam.config import CALM, RematchConfig
from sst_graph.slam.covariance import (
    Robust,
    TermSums,
    covariance_warnings,
    fit_errors,
    inflation,
    least_errors,
    robust_covariance,
    rows_of,
    total,
)
from sst_graph.slam.object_sides import ObjectSides
from sst_graph.slam.solving import moved_px, proximal, widest_px
from sst_graph.slam.term_warnings import (
    TermWarning,
    far_from_start,
    far_linearization,
    last_warnings,
    uncertainty_px,
    wide_uncertainty,
)
from sst_graph.types import FloatArray

Solver = gtsam.ISAM2 | gtsam.IncrementalFixedLagSmoother


_REMATCH_PX, _REMATCH_SHARE = 0.3, 0.075
"""A term is matched again when the estimate has moved its points by more (RMS) [px], or, under a narrow
kernel, by more than this share of it: less than what counts as calm."""
_ROUNDS = 2
"""Most rounds of matching an update: bounds its time; the next update goes on."""
_KNOWN, _KNOWN_PX = 0.5, 1.0
"""The kernel is narrowed only when extrinsic and offset are known to less than this share of it in the image,
or to less than a pixel (one sigma): a single image must not decide."""
_RESCALE = 0.2
"""The factors are made again when the scale of their information is off by more than this share."""


@dataclass(frozen=True)
class IncrementalUpdate:
    """The state after an update.

    Attributes:
        values: the estimate.
        covariance: (7, 7) cluster-robust, of extrinsic and offset, once the kernel has its last scale; until
            then the solver's marginal, proximal prior included. In a gap, when no term has a factor, that of
            the terms whose poses a smoother has marginalized.
        kernel_px: scale of the kernel [px].
        converged: the kernel has its last scale, the proximal prior is gone, no term needs matching; so it
            stays in a gap.
        rematched: how many factors were swapped.
        waiting: terms that have no factor, and why.
        warnings: what may be wrong; of the start, at the first matches and by ``converge``.
    """

    values: gtsam.Values
    covariance: FloatArray
    kernel_px: float
    converged: bool
    rematched: int
    waiting: Mapping[TermState, int]
    warnings: tuple[TermWarning, ...]


class IncrementalTerms:
    """The alignment terms of one camera in one solver."""

    def __init__(self, solver: Solver, keys: AlignmentKeys, config: RematchConfig | None = None) -> None:
        """solver: yours; all later updates go through :meth:`update`. keys: those of the terms.

        Relinearize at every update and from small steps on: ``relinearizeSkip = 1`` and a threshold of 1e-4
        [rad, m, s]. With gtsam's default, 0.1, the estimate stops early and its covariance is wrong.

        Raises:
            FactorError: no solver, no keys.
            ConfigError: no settings.
        """
        solvers = (gtsam.ISAM2, gtsam.IncrementalFixedLagSmoother)
        expected = "a gtsam.ISAM2 or gtsam.IncrementalFixedLagSmoother"
        checked_type("solver of IncrementalTerms", solver, solvers, expected)
        checked_type("keys of IncrementalTerms", keys, AlignmentKeys, "an AlignmentKeys")
        self._solver, self._keys = solver, keys
        self._config = expect_settings(config, RematchConfig)
        self._terms: list[_Placed] = []
        self._proximal: dict[int, gtsam.NonlinearFactor] = {}
        self._stamps: dict[int, float] = {}
        self._kernel_px = self._config.first_px
        self._with_proximal, self._information = True, 1.0
        self._sides = ObjectSides()
        self._gone, self._errors = TermSums(), least_errors(self._config)
        self._start: tuple[gtsam.Values, FloatArray] | None = None
        self._start_warnings: list[TermWarning] = []
        self._begun, self._has_new_terms = False, False

    def update(
        self,
        graph: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        terms: Sequence[AlignmentTerm] = (),
        stamps: Mapping[int, float] | None = None,
    ) -> IncrementalUpdate:
        """New factors and variables, then the terms matched where the estimate has come to.

        Args:
            graph, values: as the solver's own ``update`` takes them; the first hold extrinsic and offset.
            terms: new ones; a term whose image lies after the last pose waits for it.
            stamps: for a smoother, stamp of each variable [s], of each new pose of the trajectory at least;
                extrinsic and offset are stamped again here.

        Raises:
            FactorError: no graph, no values, no terms, no stamps; terms of another camera, or one that is
                there already; a new variable that is there already, a factor on one that is not. Nothing has
                been given to the solver then.
            EstimationError: the solver does not determine extrinsic and offset.
        """
        where = "IncrementalTerms.update"
        checked_type(f"graph of {where}", graph, gtsam.NonlinearFactorGraph, "a NonlinearFactorGraph")
        checked_type(f"values of {where}", values, gtsam.Values, "a gtsam.Values")
        checked_terms(where, terms, self._keys, [placed.term for placed in self._terms])
        given = self._checked_stamps(where, stamps, values)
        expect_factors_of(where, graph, self._keys, ())
        self._check_variables(where, graph, values)
        stamps = self._stamped(given)
        self._begun = True
        self._solve(graph, values, stamps, self._leaving(stamps))
        self._terms += [_Placed(term) for term in terms]
        self._has_new_terms |= bool(terms)
        return self._rematch(_ROUNDS)

    def converge(self, most_rounds: int | None = None) -> IncrementalUpdate:
        """Rounds of matching without anything new, until they change nothing.

        Where terms have come since the last time, the kernel is wide again first: it was narrowed by the
        first images, which may not tell a shift forward from an image taken later. Not so in a gap, when no
        term can have a factor: it would not be narrowed again.

        Raises:
            FactorError: no number of rounds.
            EstimationError: there has been no update, or extrinsic and offset are not determined.
        """
        rounds = self._config.most_rounds
        if most_rounds is not None:
            rounds = checked_count("most_rounds of IncrementalTerms.converge", most_rounds)
        if not self._begun:
            raise EstimationError(
                "IncrementalTerms.converge: found no update before it, expected one or more"
            )
        if self._has_new_terms and self._can_match():
            self._kernel_px, self._with_proximal, self._has_new_terms = self._config.first_px, True, False
        update = self._rematch(rounds)
        return replace(update, warnings=tuple(dict.fromkeys((*self._start_warnings, *update.warnings))))

    # --- rounds

    def _rematch(self, rounds: int) -> IncrementalUpdate:
        rematched, converged, estimate = 0, False, self._solver.calculateEstimate()
        first_warnings: list[TermWarning] = []
        alone = self._marginal()[:7, :7] if self._start is None else None
        for _ in range(rounds):
            self._retire(estimate)
            rematched += self._swap(estimate)
            before, estimate = estimate, self._solver.calculateEstimate()
            if alone is not None and self._matches():
                first_warnings = wide_uncertainty(self._matches(), before, alone)
                self._start_warnings = first_warnings
                self._start, alone = (before, alone), None
            covariance, found, converged = self._anneal(estimate)
            if converged or not self._matches():
                break
        warnings = first_warnings
        matches = self._matches()
        if self._kernel_px == self._config.last_px:
            tried = [p.matches for p in self._terms if p.matches is not None and p.matches.place is not None]
            warnings = warnings + last_warnings(tried, estimate, covariance, self._config)
            point = self._solver.getLinearizationPoint()
            smoother = not isinstance(self._solver, gtsam.ISAM2)
            warnings = warnings + far_linearization(self._keys, matches, point, estimate, smoother)
            if found is not None:
                P, cTl = self._marginal()[:7, :7], self._keys.extrinsic(estimate)
                warnings = warnings + covariance_warnings(P, found, cTl, self._config)
            if self._start is not None:
                start, known = self._start
                warnings = warnings + far_from_start(self._keys, start, estimate, known)
        return IncrementalUpdate(
            estimate,
            covariance,
            self._kernel_px,
            converged,
            rematched,
            self._waiting(),
            tuple(dict.fromkeys(warnings)),
        )

    def _anneal(self, estimate: gtsam.Values) -> tuple[FloatArray, Robust | None, bool]:
        """The next kernel; covariance (7, 7), robust at the last kernel, and whether all has converged."""
        config = self._config
        P, matches = self._marginal(), self._matches()
        widest = widest_px(matches, self._kernel_px)
        known = uncertainty_px(matches, estimate, P[:7, :7]) < max(_KNOWN * widest, _KNOWN_PX)
        calm = moved_px(matches, estimate) < CALM * widest
        if self._kernel_px > config.last_px:
            if calm and known:
                self._kernel_px = config.narrower(self._kernel_px)
            return P[:7, :7], None, False
        if self._with_proximal:
            self._with_proximal = not (calm and known)
            return P[:7, :7], None, False
        found, least = self._robust(P, estimate)
        # The scale is that of what is known beforehand: it must not change with the residuals of the moment,
        # for factors that have been marginalized keep theirs.
        wanted = 1.0 / inflation(least.independent, least.clustered)
        if abs(wanted / self._information - 1.0) > _RESCALE:
            self._information = wanted
            return found.covariance, found, False
        fresh = not any(self._needs_matching(p, estimate) for p in self._terms if p.slots)
        return found.covariance, found, fresh

    def _robust(self, P: FloatArray, estimate: gtsam.Values) -> tuple[Robust, Robust]:
        """The robust covariance by the errors that the present frames show, and by the least ones.

        Frames that have left count by their sums; where there are no others, with the errors shown last.
        """
        matches = self._matches()
        rows = [rows_of(each, self._sides, estimate) for each in matches]
        sums = total(TermSums.of(each, m.information) for each, m in zip(rows, matches, strict=True))
        sums = sums + self._gone
        if rows:
            self._errors = fit_errors(rows, self._config)
        errors = self._errors, least_errors(self._config)
        found, least = (robust_covariance(P, sums, each, self._keys) for each in errors)
        return found, least

    def _swap(self, estimate: gtsam.Values) -> int:
        """Match terms that need it; new factors in, old ones and the old proximal prior out, at once.

        Gives how many new factors of terms there are.
        """
        changed = [placed for placed in self._terms if self._needs_matching(placed, estimate)]
        graph, owners, removed = gtsam.NonlinearFactorGraph(), list[_Placed | None](), list[int]()
        for placed in changed:
            removed += self._slots_of(placed.slots)
            matches = placed.term.matched(estimate, self._kernel_px, self._information)
            placed.set(matches, self._sums(matches, estimate))
            if matches.factor is not None:
                graph.add(matches.factor)
                owners.append(placed)
        matches_now = self._matches()
        removed += self._slots_of(self._proximal)
        self._proximal = {}
        if self._with_proximal and matches_now:
            widest = widest_px(matches_now, self._kernel_px)
            for prior in _factors(proximal(matches_now, estimate, widest, self._keys)):
                graph.add(prior)
                owners.append(None)
        if graph.size() or removed:
            slots = self._solve(graph, gtsam.Values(), {}, removed)
            for owner, slot in zip(owners, slots, strict=True):
                owned = self._proximal if owner is None else owner.slots
                owned[slot] = self._graph().at(slot)
        return sum(bool(placed.slots) for placed in changed)

    def _sums(self, matches: TermMatches, estimate: gtsam.Values) -> TermSums:
        return TermSums.of(rows_of(matches, self._sides, estimate), matches.information)

    def _needs_matching(self, placed: _Placed, estimate: gtsam.Values) -> bool:
        matches = placed.matches
        if matches is None or matches.factor is None:
            return True
        return (
            matches.kernel_px != self._kernel_px
            or matches.information != self._information
            or matches.left_interval_s(estimate) > 0.0
            or matches.moved_px(estimate) > min(_REMATCH_PX, _REMATCH_SHARE * matches.scale_px)
        )

    def _retire(self, estimate: gtsam.Values) -> None:
        """Drop terms on poses that the smoother has marginalized: they stay in its marginal as they are.

        Their sums are kept from when their poses were last there.
        """
        gone = [placed for placed in self._terms if placed.is_gone(estimate, self._stamps)]
        for placed in gone:
            self._gone = self._gone + placed.sums
        self._terms = [placed for placed in self._terms if placed not in gone]

    def _matches(self) -> list[TermMatches]:
        return [p.matches for p in self._terms if p.matches is not None and p.matches.factor is not None]

    def _can_match(self) -> bool:
        """Whether a term has a factor, or would have one under the widest kernel."""
        if self._matches():
            return True
        estimate, first_px = self._solver.calculateEstimate(), self._config.first_px
        return any(placed.term.matched(estimate, first_px).factor is not None for placed in self._terms)

    def _waiting(self) -> dict[TermState, int]:
        states = [p.matches.state for p in self._terms if p.matches is not None and p.matches.factor is None]
        return {state: states.count(state) for state in dict.fromkeys(states)}

    # --- solver

    def _solve(
        self,
        graph: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        stamps: Mapping[int, float],
        removed: Sequence[int],
    ) -> list[int]:
        """One update; slots of the new factors."""
        if isinstance(self._solver, gtsam.ISAM2):
            return list(self._solver.update(graph, values, list(removed)).getNewFactorsIndices())
        self._solver.update(graph, values, cast(Any, dict(stamps)), list(removed))
        return list(self._solver.getISAM2Result().getNewFactorsIndices())

    def _graph(self) -> gtsam.NonlinearFactorGraph:
        if isinstance(self._solver, gtsam.ISAM2):
            return self._solver.getFactorsUnsafe()
        return self._solver.getFactors()

    def _slots_of(self, factors: Mapping[int, gtsam.NonlinearFactor]) -> list[int]:
        """Slots that still hold the factors that were put there: a smoother uses those of others again."""
        graph = self._graph()
        return [slot for slot, factor in factors.items() if slot < graph.size() and graph.at(slot) is factor]

    def _marginal(self) -> FloatArray:
        """(n, n) by the solver, over the columns that all terms share."""
        if not self._keys.lasting:
            return np.zeros((COLUMNS, COLUMNS))
        try:
            joint = self._isam().jointMarginalCovariance(list(self._keys.lasting))
        except (RuntimeError, IndexError):  # indeterminate, or no factor in the solver touches them
            found = "a solver that does not determine extrinsic and time offset"
            raise EstimationError(f"IncrementalTerms: found {found}, expected priors on them") from None
        return self._keys.placed(np.asarray(joint.fullMatrix()))

    def _isam(self) -> gtsam.ISAM2:
        return self._solver if isinstance(self._solver, gtsam.ISAM2) else self._solver.getISAM2()

    # --- what is given

    def _check_variables(self, where: str, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        """What would leave the solver unusable, before it is given anything."""
        isam, new = self._isam(), set(values.keys())
        for key in sorted(new):
            if isam.valueExists(key):
                expected = "new variables only"
                raise FactorError(f"values of {where}", f"{key_name(key)}, which is there already", expected)
        factors = factors_of(graph)
        for key in sorted({*self._keys.lasting, *(int(key) for one in factors for key in list(one.keys()))}):
            if key not in new and not isam.valueExists(key):
                expected = "a value for each key of the graph, of extrinsic, offset and biases"
                raise FactorError(f"values of {where}", f"no {key_name(key)}", expected)
        every = gtsam.Values(isam.getLinearizationPoint())
        every.insert(values)
        self._keys.check_kinds(every)
        expect_kinds(f"values of {where}", every, factors)

    def _checked_stamps(
        self, where: str, stamps: Mapping[int, float] | None, values: gtsam.Values
    ) -> dict[int, float]:
        """The stamps [s]; a smoother needs those of new poses, which it would keep for ever without."""
        what = f"stamps of {where}"
        checked_type(what, stamps, (Mapping, type(None)), "a dict from keys to seconds")
        found = {
            checked_key(where, "stamps", key): checked_number(what, seconds)
            for key, seconds in (stamps or {}).items()
        }
        if not isinstance(self._solver, gtsam.ISAM2):
            for key in list(values.keys()):
                if key in self._keys.trajectory and key not in found:
                    raise FactorError(what, f"none for {key_name(key)}", "one for each new pose")
        return found

    def _stamped(self, found: dict[int, float]) -> dict[int, float]:
        if isinstance(self._solver, gtsam.ISAM2):
            return {}
        if found:
            latest = max(found.values())
            found.update(dict.fromkeys(self._keys.lasting, latest))
        self._stamps.update(found)
        return found

    def _leaving(self, stamps: Mapping[int, float]) -> list[int]:
        """Slots of terms whose poses this update marginalizes, while the kernel is still wide."""
        if not stamps or (self._kernel_px == self._config.last_px and not self._with_proximal):
            return []
        assert not isinstance(self._solver, gtsam.ISAM2)
        horizon = max(stamps.values()) - self._solver.smootherLag()
        leaving = {key for key, stamp in self._stamps.items() if stamp < horizon}
        slots = []
        for placed in self._terms:
            place = None if placed.matches is None else placed.matches.place
            if place is not None and leaving & place.poses:
                slots += self._slots_of(placed.slots)
                placed.slots, placed.sums = {}, TermSums()
        return slots


class _Placed:
    """A term in the solver: its matches, and the slot of its factor."""

    def __init__(self, term: AlignmentTerm) -> None:
        self.term = term
        self.matches: TermMatches | None = None
        self.slots: dict[int, gtsam.NonlinearFactor] = {}
        self.sums = TermSums()

    def set(self, matches: TermMatches, sums: TermSums) -> None:
        self.matches, self.sums, self.slots = matches, sums, {}

    def is_gone(self, estimate: gtsam.Values, known: Container[int]) -> bool:
        """Whether a pose of its factor, or every pose it could be on, has left the solver.

        known: poses that a smoother has been given; of another solver none, for there they stay.
        """
        if self.matches is None:
            return False
        if self.matches.place is not None:
            return not all(estimate.exists(key) for key in self.matches.place.poses)
        if self.matches.state != TermState.BEFORE_TRAJECTORY:
            return False
        first, _ = self.term.keys.trajectory.at(0)
        return first in known and not estimate.exists(first)


def _factors(graph: gtsam.NonlinearFactorGraph) -> list[gtsam.NonlinearFactor]:
    return [graph.at(i) for i in range(graph.size())]
