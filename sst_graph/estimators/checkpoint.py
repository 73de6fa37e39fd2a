"""A tracker on disk: one npz file, written whole or not at all, arrays and JSON only."""

from __future__ import annotations

import io
import json
import zlib
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import gtsam
import numpy as np

from factors.camera import PinholeCamera
from sst_graph.association.boundary import Boundaries
from sst_graph.config import from_dict, to_dict
from sst_graph.errors import DataError
from sst_graph.estimators.epochs import RetiredEpoch
from sst_graph.estimators.gaussian import Gaussian, Point
from sst_graph.estimators.incremental import Tracker
from sst_graph.estimators.object_sums import ObjectBelief, ObjectSums
from sst_graph.estimators.score_sums import ScoreSums
from sst_graph.estimators.settling import Milestones, Settling
from sst_graph.estimators.smoother import WindowSmoother
from sst_graph.estimators.tracker_config import TrackerConfig
from sst_graph.estimators.tracker_start import Guess
from sst_graph.estimators.undecided import Undecided
from sst_graph.estimators.undersides import UndersideSupport
from sst_graph.estimators.window import Sighting, Window
from sst_graph.files import atomic_write_bytes
from sst_graph.problem.drive import ScanFeatures, apart, image_features, outlines
from sst_graph.problem.velocity import ObjectVelocity
from sst_graph.types import CameraImage, RelativeMotion, Scan, SemanticClass
from sst_graph.uncertainty.covariance import ErrorModel

FORMAT = "sst-graph/tracker"
VERSION = 9

Arrays = dict[str, Any]
_BOUNDARY = ("lPs", "outward", "half_gaps_m", "offsets_s", "edges", "objects")
_SCAN = ("points", "classes", "instances", "offsets_s", "rings")


def save_checkpoint(tracker: Tracker, path: str | Path) -> None:
    """Write a tracker; a file that exists is replaced in one step.

    Raises:
        OSError: it cannot be written; what stood there is untouched.
    """
    arrays: Arrays = {}
    head = {
        "format": FORMAT,
        "version": VERSION,
        "config": to_dict(tracker.config),
        "camera": asdict(tracker.camera),
        "guess": _guess_document(tracker.guess),
        "alarmed": tracker.alarmed,
        "attempts": tracker.attempts,
        "waited": tracker.waited,
        "watched": list(tracker.watch.scans),
        "milestones": [tracker.milestones.first, tracker.milestones.next],
        "settling": None if tracker.settling is None else _settling_document(tracker.settling),
        "inflation": tracker.inflation,
        "undersides": [int(c) for c in tracker.matcher.graph.undersides],
        "alarm": [tracker.watch.alarm.raised, tracker.watch.alarm.quiet],
        "confirmed": [tracker.watch.confirmation.turn_s, tracker.watch.confirmation.offset_s],
        "suspects": sorted(tracker.watch.confirmation.suspects),
        "window": _put_window(arrays, tracker.window),
        "smoother": None if tracker.smoother is None else _put_smoother(arrays, tracker.smoother),
        "adopted": tracker.adopted is not None,
        "last_scan": None if tracker.last_scan is None else tracker.last_scan.stamp_ns,
        "history": [epoch.start_ns for epoch in tracker.history_store.epochs],
    }
    arrays["covariance"] = tracker.covariance
    arrays["arrivals"] = np.array(tracker.arrivals.rows).reshape(-1, 9)
    arrays["entered"] = np.array(tracker.entered, np.int64)
    arrays["usual"] = np.array(tracker.watch.alarm.usual)
    arrays["costs"] = np.array(tracker.adoption.costs).reshape(-1, 2)
    if tracker.adopted is not None:
        _put_point(arrays, "adopted", tracker.adopted)
    if tracker.last_scan is not None:
        for name in _SCAN:
            value = getattr(tracker.last_scan, name)
            if value is not None:
                arrays[f"last_scan/{name}"] = value
    for i, epoch in enumerate(tracker.history_store.epochs):
        _put_gaussian(arrays, f"history/{i}", epoch.belief)
        arrays[f"history/{i}/surplus"] = epoch.surplus
    arrays["head"] = np.frombuffer(json.dumps(head).encode(), np.uint8)
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    atomic_write_bytes(path, stream.getvalue())


def load_checkpoint(path: str | Path) -> Tracker:
    """The tracker in a checkpoint, at the estimate it was saved with.

    Raises:
        DataError: no such file, or not a checkpoint of this version.
    """
    try:
        with np.load(Path(path), allow_pickle=False) as stored:
            arrays = dict(stored)
        head = json.loads(bytes(arrays["head"]))
    except FileNotFoundError:
        raise DataError(path, "no such file", "a checkpoint of the tracker") from None
    except (OSError, ValueError, KeyError, EOFError, zlib.error, BadZipFile) as error:
        raise DataError(path, f"no readable checkpoint ({error})", "a checkpoint of the tracker") from error
    found = (head.get("format"), head.get("version"))
    if found != (FORMAT, VERSION):
        raise DataError(path, f"{found[0]} version {found[1]}", f"{FORMAT} version {VERSION}")
    try:
        return _tracker(head, arrays)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(path, f"an incomplete checkpoint ({error})", "all of a tracker") from error


def _tracker(head: Mapping[str, Any], arrays: Arrays) -> Tracker:
    camera = PinholeCamera(**head["camera"])
    tracker = Tracker(camera, from_dict(TrackerConfig, head["config"]))
    tracker.guess = _guess(head["guess"])
    tracker.alarmed, tracker.attempts, tracker.waited = head["alarmed"], head["attempts"], head["waited"]
    tracker.inflation = head["inflation"]
    undersides = tuple(SemanticClass(c) for c in head["undersides"])
    tracker.matcher.graph = replace(tracker.matcher.graph, undersides=undersides)
    first, following = head["milestones"]
    tracker.milestones = Milestones(first, following, tracker.config.window)
    tracker.watch.scans.extend(head["watched"])
    tracker.watch.alarm.raised, tracker.watch.alarm.quiet = head["alarm"]
    tracker.watch.confirmation.turn_s, tracker.watch.confirmation.offset_s = head["confirmed"]
    tracker.watch.confirmation.suspects.update(head["suspects"])
    tracker.watch.alarm.usual.extend(arrays["usual"].tolist())
    tracker.adoption.costs.extend((float(a), float(b)) for a, b in arrays["costs"])
    tracker.adoption.adopted = _point(arrays, "adopted") if head["adopted"] else None
    tracker.entered.extend(arrays["entered"].tolist())
    _get_window(arrays, head["window"], tracker)
    for i, start_ns in enumerate(head["history"]):
        belief = _gaussian(arrays, f"history/{i}")
        tracker.history_store.epochs.append(RetiredEpoch(start_ns, belief, arrays[f"history/{i}/surplus"]))
    if head["last_scan"] is not None:
        parts: dict[str, Any] = {name: arrays.get(f"last_scan/{name}") for name in _SCAN}
        tracker.last_scan = Scan(stamp_ns=head["last_scan"], **parts)
        tracker.odometry.add(tracker.last_scan)
    if head["smoother"] is not None:
        smoother = _get_smoother(arrays, head["smoother"], tracker)
        tracker.resume(smoother, set(head["smoother"]["entries"]), _point(arrays, "point"))
        if head["settling"] is not None:
            tracker.settling = _settling(head["settling"], tracker)
    tracker.covariance = arrays["covariance"]
    tracker.arrivals.rows.extend(arrays["arrivals"])
    if tracker.smoother is not None:
        tracker.arrivals.restart(tracker.covariance[:7, :7])
    return tracker


def _put_window(arrays: Arrays, window: Window) -> dict[str, Any]:
    scans = []
    for number, scan in window.scans:
        place = f"scan/{number}"
        arrays[f"{place}/lPs"], arrays[f"{place}/classes"] = scan.lPs, scan.classes
        arrays[f"{place}/offsets_s"] = scan.offsets_s
        for c, boundaries in outlines(scan, scan.undersides).items():
            for name in _BOUNDARY:
                arrays[f"{place}/{int(c)}/{name}"] = getattr(boundaries, name)
        tracks = [[int(c), number_, track] for (c, number_), track in window.tracks[number].items()]
        scans.append([number, scan.index, scan.stamp_ns, [int(c) for c in scan.boundaries], tracks])
    for i, image in enumerate(window.images):
        arrays[f"image/{i}"] = np.frombuffer(zlib.compress(image.mask.tobytes(), 1), np.uint8)
    for i, motion in enumerate(window.motions):
        arrays[f"motion/{i}"], arrays[f"motion/{i}/covariance"] = motion.aTb.matrix(), motion.covariance
    arrays["wTl"] = window.wTl.matrix()
    objects = window.objects
    return {
        "next_scan": window.next_scan,
        "next_image": window.next_image,
        "scans": scans,
        "images": [[image.index, image.stamp_ns] for image in window.images],
        "motions": [[motion.from_ns, motion.to_ns, motion.ok] for motion in window.motions],
        "objects": [
            [track, int(c), place.tolist(), objects.last_seen[track]]
            for track, (c, place) in objects.live.items()
        ],
        "objects_seen": [objects.scans, objects.following],
        "sightings": [
            [track, s.scan, int(s.name[0]), s.name[1], s.stamp_ns, s.centre.tolist()]
            for track, seen in window.sightings.items()
            for s in seen
        ],
        "moving": [
            [scan, int(c), number, speed]
            for scan, speeds in window.moving.items()
            for (c, number), speed in speeds.items()
        ],
        "persistence": [
            [scan, int(c), number, shares.tolist()]
            for scan, by_name in window.persistence.shares.items()
            for (c, number), shares in by_name.items()
        ],
        "velocities": [
            [track, scan, velocity.l_velocity.tolist(), velocity.sigma_mps]
            for track, known in window.velocities.found.items()
            for scan, velocity in known.items()
        ],
        "judged_anew": sorted(window.judged_anew),
    }


def _get_window(arrays: Arrays, head: Mapping[str, Any], tracker: Tracker) -> None:
    window, camera, nothing = tracker.window, tracker.camera, np.zeros((0, 3), np.float32)
    for number, index, stamp_ns, classes, tracks in head["scans"]:
        place = f"scan/{number}"
        found = {
            SemanticClass(c): Boundaries(**{name: arrays[f"{place}/{c}/{name}"] for name in _BOUNDARY})
            for c in classes
        }
        lPs, labels, offsets_s = (arrays[f"{place}/{name}"] for name in ("lPs", "classes", "offsets_s"))
        boundaries, below = apart(found)
        features = ScanFeatures(
            index, stamp_ns, boundaries, lPs, labels, offsets_s, nothing, nothing[:, 0], below
        )
        window.scans.append((number, features))
        window.tracks[number] = {(SemanticClass(c), n): track for c, n, track in tracks}
    for i, (index, stamp_ns) in enumerate(head["images"]):
        mask = np.frombuffer(zlib.decompress(arrays[f"image/{i}"].tobytes()), np.uint8)
        mask = mask.reshape(camera.height, camera.width)
        image = CameraImage(stamp_ns, mask, np.zeros((0, 0, 3), np.uint8))
        window.images.append(image_features(index, image, tracker.classes))
    for i, (from_ns, to_ns, ok) in enumerate(head["motions"]):
        pose, covariance = gtsam.Pose3(arrays[f"motion/{i}"]), arrays[f"motion/{i}/covariance"]
        window.motions.append(RelativeMotion(from_ns, to_ns, pose, covariance, ok))
    window.wTl = gtsam.Pose3(arrays["wTl"])
    window.next_scan, window.next_image = head["next_scan"], head["next_image"]
    for track, c, place, last in head["objects"]:
        window.objects.live[track] = (SemanticClass(c), np.array(place))
        window.objects.last_seen[track] = last
    window.objects.scans, window.objects.following = head["objects_seen"]
    for track, scan, c, number, stamp_ns, centre in head["sightings"]:
        sighting = Sighting(scan, (SemanticClass(c), number), stamp_ns, np.array(centre))
        window.sightings.setdefault(track, []).append(sighting)
    for scan, c, number, speed in head["moving"]:
        window.moving.setdefault(scan, {})[SemanticClass(c), number] = speed
    window.judged_anew = set(head["judged_anew"])
    _get_movers(head["persistence"], window)
    for track, scan, l_velocity, sigma_mps in head["velocities"]:
        window.velocities.take_over(scan, track, ObjectVelocity(np.array(l_velocity), sigma_mps))


def _get_movers(rows: Sequence[Any], window: Window) -> None:
    """What has been found again, the latest scans for those to come, and all outlines, backwards in time."""
    persistence, led_by = window.persistence, {motion.to_ns: motion for motion in window.motions}
    persistence.shares = {number: {} for number, _ in window.scans}
    for scan, c, number, shares in rows:
        persistence.shares[scan][SemanticClass(c), number] = np.array(shares)
    wTl = window.wTl
    for number, features in reversed(window.scans):
        if window.scans[-1][1].stamp_ns - features.stamp_ns <= persistence.memory_ns:
            persistence.remember(number, features, wTl)
        window.velocities.remember(number, features, window.tracks[number], wTl)
        motion = led_by.get(features.stamp_ns)
        if motion is None:
            break
        wTl = wTl.compose(motion.aTb.inverse())


def _put_smoother(arrays: Arrays, smoother: WindowSmoother) -> dict[str, Any]:
    sums = smoother.sums
    _put_gaussian(arrays, "past", smoother.past)
    _put_gaussian(arrays, "bent", smoother.bent)
    for name, value in vars(smoother.undecided).items():
        arrays[f"undecided/{name}"] = value
    _put_gaussian(arrays, "prior", smoother.prior)
    _put_point(arrays, "point", smoother.point)
    arrays["sums/JJ"], arrays["sums/frames"], arrays["sums/closed"] = sums.JJ, sums.frames, sums.closed
    arrays["sums/live"] = np.array([row for row, _ in sums.live.values()])
    arrays["sums/sides"] = np.array([[side, last] for side, (_, last) in sums.live.items()], np.int64)
    arrays["sums/objects/closed"] = sums.objects.closed
    for track, own in sums.objects.live.items():
        _put_gaussian(arrays, f"sums/objects/{track}", own.belief)
    arrays["sums/recent"] = np.concatenate([np.zeros((0, 6)), *sums.recent])
    return {
        "start_ns": smoother.epochs[0].start_ns,
        "entries": sorted(smoother.entries),
        "model": [smoother.model.side, smoother.model.side_frame, smoother.model.match],
        "recent": [len(rows) for rows in sums.recent],
        "objects": [sums.objects.count, sums.objects.weight, sums.objects.weight2],
        "live": [[track, own.weight] for track, own in sums.objects.live.items()],
        "weights": [sums.weight, sums.curvature],
    }


def _get_smoother(arrays: Arrays, head: Mapping[str, Any], tracker: Tracker) -> WindowSmoother:
    recent = np.split(arrays["sums/recent"], np.cumsum(head["recent"])[:-1]) if head["recent"] else []
    sums = ScoreSums(arrays["sums/JJ"], arrays["sums/frames"], arrays["sums/closed"])
    sums.recent = deque(recent, sums.recent.maxlen)
    sums.weight, sums.curvature = head["weights"]
    live = {
        track: ObjectBelief(_gaussian(arrays, f"sums/objects/{track}"), weight)
        for track, weight in head["live"]
    }
    count, weight, weight2 = head["objects"]
    sums.objects = ObjectSums(arrays["sums/objects/closed"], count, weight, weight2, live)
    for (side, last), row in zip(arrays["sums/sides"].reshape(-1, 2), arrays["sums/live"], strict=True):
        sums.live[int(side)] = (row, int(last))
    smoother = WindowSmoother(
        _gaussian(arrays, "past"),
        head["start_ns"],
        tracker.classes,
        tracker.config.calibration.joint.graph,
        tracker.config.drift,
        sums,
        ErrorModel(*head["model"]),
        _gaussian(arrays, "prior"),
        _gaussian(arrays, "bent"),
    )
    parts = {name: arrays[f"undecided/{name}"] for name in vars(smoother.undecided)}
    smoother.undecided = Undecided(**parts)
    return smoother


def _put_point(arrays: Arrays, name: str, point: Point) -> None:
    arrays[f"{name}/cTl"] = point.cTl.matrix()
    arrays[f"{name}/rest"] = np.array([point.offset_s, *point.biases_px])
    arrays[f"{name}/tracks"] = np.array(point.tracks, np.int64)
    arrays[f"{name}/objects"] = point.object_biases_px


def _point(arrays: Arrays, name: str) -> Point:
    rest = arrays[f"{name}/rest"]
    tracks = tuple(arrays[f"{name}/tracks"].tolist())
    cTl = gtsam.Pose3(arrays[f"{name}/cTl"])
    return Point(cTl, float(rest[0]), rest[1:], tracks, arrays[f"{name}/objects"])


def _put_gaussian(arrays: Arrays, name: str, belief: Gaussian) -> None:
    _put_point(arrays, name, belief.point)
    arrays[f"{name}/information"], arrays[f"{name}/vector"] = belief.information, belief.vector


def _gaussian(arrays: Arrays, name: str) -> Gaussian:
    return Gaussian(_point(arrays, name), arrays[f"{name}/information"], arrays[f"{name}/vector"])


def _settling_document(settling: Settling) -> dict[str, Any]:
    below, support = settling.below, None
    if below is not None:
        classes = sorted({*below.narrow, *below.wide})
        support = [[int(c), below.narrow.get(c, 0.0), below.wide.get(c, 0.0)] for c in classes]
    return {"below": support, "passes": settling.passes, "done": sorted(settling.done)}


def _settling(document: Mapping[str, Any], tracker: Tracker) -> Settling:
    tracker.window.held = tracker.window.first_scan == tracker.milestones.first
    settling, support = Settling(tracker.matcher, tracker.config.settle_scans), document["below"]
    settling.passes, settling.done = document["passes"], set(document["done"])
    settling.below = None
    if support is not None:
        narrow, wide = ({SemanticClass(row[0]): row[i] for row in support} for i in (1, 2))
        settling.below = UndersideSupport(narrow, wide)
    return settling


def _guess_document(guess: Guess) -> dict[str, Any]:
    pose = None if guess.cTl is None else guess.cTl.matrix().tolist()
    return {"cTl": pose, "offset_s": guess.offset_s, "search": guess.search}


def _guess(document: Mapping[str, Any]) -> Guess:
    pose = None if document["cTl"] is None else gtsam.Pose3(np.array(document["cTl"]))
    return Guess(pose, document["offset_s"], document["search"])
