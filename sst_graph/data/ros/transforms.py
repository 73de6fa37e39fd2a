"""Transforms of /tf and /tf_static, and the pose of one frame in another where they determine it."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np

_ROUNDED = 2e-2
"""Most that the length of a quaternion may be off 1, as in one that was typed by hand (0.7 0 0 0.7)."""
_LISTED = 12
"""Frames that a message lists at most."""
_SAME = 1e-6
"""Transforms that differ by less [m, and in the elements of the rotation] are the same."""
_STEADY_M, _STEADY_RAD = 1e-3, 1e-4
"""Transforms that differ by less are constant ones that software published with rounding."""


class Transforms:
    """Poses of child frames in parent frames, as they are published over a drive."""

    def __init__(self) -> None:
        self._poses: dict[tuple[str, str], gtsam.Pose3] = {}
        self._moving: set[tuple[str, str]] = set()
        self._rounded: set[tuple[str, str]] = set()
        self._wrong: dict[tuple[str, str], str] = {}

    def add(self, message: Any) -> None:
        """Take the transforms of a TFMessage."""
        for one in message.transforms:
            pose, wrong = _pose(one.transform)
            self.add_pose(one.header.frame_id, one.child_frame_id, pose)
            if wrong:
                self._wrong[_frame(one.header.frame_id), _frame(one.child_frame_id)] = wrong

    def add_pose(self, parent: str, child: str, pose: gtsam.Pose3) -> None:
        """Take the pose of ``child`` in ``parent``."""
        edge = _frame(parent), _frame(child)
        known = self._poses.setdefault(edge, pose)
        if known.equals(pose, _SAME):
            return
        step = gtsam.Pose3.Logmap(known.between(pose))
        steady = np.linalg.norm(step[:3]) <= _STEADY_RAD and np.linalg.norm(step[3:]) <= _STEADY_M
        (self._rounded if steady else self._moving).add(edge)

    def joined(self, other: Transforms) -> Transforms:
        """The transforms of this file and of another one."""
        both = Transforms()
        for one in (self, other):
            for (parent, child), pose in one._poses.items():
                both.add_pose(parent, child, pose)
            both._moving |= one._moving
            both._rounded |= one._rounded
            both._wrong |= one._wrong
        return both

    def beside(self, other: Transforms) -> Transforms:
        """What is left of these where another file's take their place.

        A frame that has a pose there has none here. Where its parent there is below it here, the parent has
        no pose here either: it would be above and below at once.
        """
        kept = self._without({child for _, child in other._poses})
        for parent, child in other._poses:
            if kept.connected(parent, child):
                kept = kept._without({parent})
        return kept

    def connected(self, one: str, other: str) -> bool:
        """Whether a chain of transforms joins two frames."""
        known = self.frames
        return one in known and other in known and self._path(one, other) is not None

    @property
    def frames(self) -> list[str]:
        """Names of all frames, each once, in the order in which they came."""
        return list(dict.fromkeys(frame for edge in self._poses for frame in edge))

    def parents(self, frame: str) -> list[str]:
        """Names of the frames in which ``frame`` has a pose."""
        return sorted(parent for parent, child in self._poses if child == frame)

    def root(self, frame: str) -> str:
        """The frame above all parents of ``frame``; itself where it has none."""
        seen = {frame}
        while (above := self.parents(frame)) and above[0] not in seen:
            frame = above[0]
            seen.add(frame)
        return frame

    def moves(self, one: str, other: str) -> bool:
        """Whether a frame moves against another, by the chain that joins them; where none does, whether it
        moves against any frame that it has a transform with. No frame moves against itself."""
        if one == other:
            return False
        path = self._path(one, other)
        if path is None:
            return any(one in edge for edge in self._moving)
        return any(edge in self._moving or edge[::-1] in self._moving for edge in pairwise(path))

    def pose(self, parent: str, child: str) -> tuple[gtsam.Pose3 | None, str]:
        """Pose of ``child`` in ``parent``, or None, and why: missing, moving, ambiguous or none."""
        if parent == child:
            return None, f"camera and LiDAR have the same frame, {parent!r}"
        path = self._path(parent, child)
        if path is None:
            return None, f"no chain of transforms from {parent!r} to {child!r}{self._unknown(parent, child)}"
        pose, rounded = gtsam.Pose3(), ""
        for first, second in pairwise(path):
            edge = (first, second) if (first, second) in self._poses else (second, first)
            if wrong := self._wrong.get(edge):
                return None, f"the transform from {edge[0]!r} to {edge[1]!r} has {wrong}"
            if edge in self._moving:
                return None, f"the transform from {edge[0]!r} to {edge[1]!r} is not constant"
            parents = self.parents(edge[1])
            if len(parents) > 1:
                return None, f"{edge[1]!r} has several parents: {', '.join(parents)}"
            if edge in self._rounded:
                rounded += f"; {edge[0]} - {edge[1]} varies, by less than 1 mm and 1e-4 rad"
            step = self._poses[edge]
            pose = pose * (step if edge == (first, second) else step.inverse())
        return pose, f"by transforms {' - '.join(path)}{rounded}"

    def _without(self, children: Collection[str]) -> Transforms:
        """All transforms but the poses of some frames."""
        kept = Transforms()
        kept._poses = {edge: pose for edge, pose in self._poses.items() if edge[1] not in children}
        kept._moving = {edge for edge in self._moving if edge in kept._poses}
        kept._rounded = {edge for edge in self._rounded if edge in kept._poses}
        kept._wrong = {edge: wrong for edge, wrong in self._wrong.items() if edge in kept._poses}
        return kept

    def _unknown(self, *frames: str) -> str:
        """Which of some frames no transform has, and which frames there are, in words."""
        names = self.frames
        missing = [frame for frame in frames if frame not in names]
        if not missing or not names:
            return ""
        some = ", ".join(names[:_LISTED]) + ", ..." * (len(names) > _LISTED)
        return f"; {' and '.join(map(repr, missing))} not among {some}"

    def _path(self, start: str, end: str) -> list[str] | None:
        """The shortest chain of frames."""
        neighbours: dict[str, list[str]] = {}
        for parent, child in self._poses:
            neighbours.setdefault(parent, []).append(child)
            neighbours.setdefault(child, []).append(parent)
        seen, waiting = {start}, deque([[start]])
        while waiting:
            path = waiting.popleft()
            if path[-1] == end:
                return path
            for other in neighbours.get(path[-1], ()):
                if other not in seen:
                    seen.add(other)
                    waiting.append([*path, other])
        return None


def _frame(name: str) -> str:
    return str(name).lstrip("/")


def _pose(transform: Any) -> tuple[gtsam.Pose3, str]:
    """The pose, and what is wrong with it; '' where nothing is.

    A message that was never filled in has a quaternion of length 0, and gtsam makes no rotation of one whose
    length is not 1.
    """
    q, t = transform.rotation, transform.translation
    wxyz, xyz = np.array([q.w, q.x, q.y, q.z]), np.array([t.x, t.y, t.z])
    length = float(np.linalg.norm(wxyz))
    if not abs(length - 1.0) <= _ROUNDED:
        return gtsam.Pose3(), f"a quaternion of length {length:.4g}, not 1"
    if not np.isfinite(xyz).all():
        return gtsam.Pose3(), "a translation that is not finite"
    return gtsam.Pose3(gtsam.Rot3.Quaternion(*(wxyz / length)), xyz), ""
