"""Frames of the cameras, the LiDAR and the vehicle, and the transforms that are written between them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam

from sst_graph.data.ros.transforms import Transforms
from sst_graph.errors import ConfigError
from sst_graph.export.options import CAMERA, NUMBER, ExportOptions
from sst_graph.export.text import heading
from sst_graph.metrics import LINK_FROM_OPTICAL
from sst_graph.result import CalibrationResult
from sst_graph.rig.result import folder_names

OPTICAL_AXES, LINK_AXES = "x right, y down, z forward", "x forward, y left, z up"


@dataclass(frozen=True)
class StaticTransform:
    """Pose of a frame in another: p_parent = pose . p_child."""

    parent: str
    child: str
    pose: gtsam.Pose3


@dataclass(frozen=True)
class CameraFrames:
    """Names of a camera's frames: its optical frame and its link."""

    optical: str
    link: str


@dataclass(frozen=True)
class Rig:
    """Cameras that are exported together; one by itself is a rig of one.

    Attributes:
        cameras: calibration of each camera, by name.
        frames: names of its frames, by name.
        options: the others' names, the direction, the vehicle.
        several: it is the result of a rig, however many cameras that has.
    """

    cameras: Mapping[str, CalibrationResult]
    frames: Mapping[str, CameraFrames]
    options: ExportOptions
    several: bool

    def lidar_in(self, frame: str | None, needs: str) -> gtsam.Pose3:
        """Pose of the LiDAR in a frame of the vehicle.

        Args:
            frame: its name; None is the LiDAR's own.
            needs: what the frame is for, in the error.

        Raises:
            ConfigError: the vehicle's transforms do not tell it.
        """
        if frame is None or frame == self.options.lidar_frame:
            return gtsam.Pose3()
        tree = self.options.tree
        if tree is None:
            raise ConfigError(
                f"frame {frame!r} ({needs}): expected a pose of {self.options.lidar_frame!r} in it, "
                "by --tree FILE"
            )
        self.check_tree()
        pose, why = tree.pose(frame, self.options.lidar_frame)
        if pose is None:
            raise ConfigError(f"--tree: {why}; expected a pose of {self.options.lidar_frame!r} in {frame!r}")
        return pose

    def check_tree(self) -> None:
        """Refuse a vehicle without the LiDAR.

        Raises:
            ConfigError: the LiDAR's frame is not there.
        """
        tree, lidar = self.options.tree, self.options.lidar_frame
        if tree is not None and lidar not in tree.frames:
            raise ConfigError(
                f"--tree: found no frame {lidar!r} among {_listed(tree.frames)}; name it by --lidar-frame"
            )

    def link_from_optical(self, name: str) -> gtsam.Pose3:
        """Pose of a camera's optical frame in its link: the vehicle's, or REP 103's."""
        return self._known_link(name) or LINK_FROM_OPTICAL

    def transforms(self) -> list[StaticTransform]:
        """What a tree of frames needs: each camera's transform, and its optical frame below its link.

        Raises:
            ConfigError: frames that are not known, or both of one side; a link that is named and at no end; a
                LiDAR below several cameras.
        """
        self.check_tree()
        found: list[StaticTransform] = []
        for number, name in enumerate(self.cameras):
            parent, child = self._ends(name, number)
            found.append(StaticTransform(parent, child, self._pose(name, parent, child)))
            frames = self.frames[name]
            if self.options.camera_link is not None and frames.link not in (parent, child):
                raise ConfigError(
                    f"--camera-link {self.options.camera_link} would change nothing: expected the link "
                    "at one end, by --parent or --child"
                )
            if frames.link in (parent, child) and self._known_link(name) is None:
                found.append(StaticTransform(frames.link, frames.optical, self.link_from_optical(name)))
        children = [one.child for one in found]
        twice = [child for child in children if children.count(child) > 1]
        if twice:
            raise ConfigError(
                f"frame {twice[0]!r}: found below several cameras, expected one parent (--parent "
                f"{self.options.lidar_frame}, or name the cameras' frames with {CAMERA})"
            )
        return found

    def replacements(self) -> list[str]:
        """The tree's own joints that the transforms take the place of, each in a sentence.

        That of a camera's frame is what the tree is given for, and is left out.

        Raises:
            ConfigError: as :meth:`transforms`.
        """
        tree, transforms = self.options.tree, self.transforms()
        if tree is None:
            return []
        of_cameras = {name for one in self.frames.values() for name in (one.optical, one.link)}
        written = Transforms()
        for one in transforms:
            written.add_pose(one.parent, one.child, one.pose)
        after = written.joined(tree.beside(written))
        said = []
        for child in dict.fromkeys(one.child for one in transforms if one.child not in of_cameras):
            parents = tree.parents(child)
            if parents:
                apart = [frame for frame in tree.frames if not after.connected(child, frame)]
                cut = f", which cuts {_listed(apart)} off from {child}" if apart else ""
                above = ", ".join(parents)
                said.append(
                    f"{child} has a parent in the tree already, {above}: the file replaces that joint{cut}"
                )
        return said

    def words(self, transforms: list[StaticTransform]) -> list[str]:
        """The transforms in sentences: axes, direction, time offset and its sign, deviations."""
        lines = ["LiDAR-camera calibration by sst-graph"]
        mounts = iter(transforms)
        for name, result in self.cameras.items():
            mount, frames = next(mounts), self.frames[name]
            link = frames.link in (mount.parent, mount.child)
            lines += self._words_of(mount, frames, link)
            if link and self._known_link(name) is None:
                next(mounts)
                lines.append(f"{frames.optical} below {frames.link}: the axes of REP 103, not measured")
            lines += heading(result, frames.optical)
        return lines

    def _words_of(self, mount: StaticTransform, frames: CameraFrames, link: bool) -> list[str]:
        axes = f"link: {LINK_AXES}" if link else f"optical frame: {OPTICAL_AXES}"
        camera = frames.link if link else frames.optical
        lidar = self.options.lidar_frame
        sides = {camera: f"{camera} (camera, {axes})", lidar: f"{lidar} (LiDAR)"}
        parent, child = (sides.get(frame, frame) for frame in (mount.parent, mount.child))
        lines = [
            f"parent {parent}, child {child}:",
            f"p_parent = T * p_child, T is the pose of {mount.child} in {mount.parent}",
        ]
        tree = self.options.tree
        above = tree.parents(mount.child) if tree is not None else []
        if above:
            lines.append(f"instead of the tree's pose of {mount.child} in {', '.join(above)}")
        return lines

    def _known_link(self, name: str) -> gtsam.Pose3 | None:
        frames, tree = self.frames[name], self.options.tree
        known = tree is not None and {frames.link, frames.optical} <= set(tree.frames)
        return tree.pose(frames.link, frames.optical)[0] if known and tree is not None else None

    def _ends(self, name: str, number: int) -> tuple[str, str]:
        """Parent and child of the transform of a camera."""
        options, frames = self.options, self.frames[name]
        own = (frames.optical, frames.link)
        above = options.lidar_frame if options.tree is None else options.tree.root(options.lidar_frame)
        parent, child = (
            None if frame is None else filled(frame, name, number)
            for frame in (options.parent, options.child)
        )
        if parent is None and child is None and options.tree is None and not self.several:
            return frames.optical, options.lidar_frame
        if parent is None:
            parent = above if child is None or child in own else frames.optical
        if child is None:
            child = options.lidar_frame if parent in own else frames.optical
        return parent, child

    def _pose(self, name: str, parent: str, child: str) -> gtsam.Pose3:
        """Pose of the child in the parent: one of them is the camera's, the other of the LiDAR's side."""
        cTl, frames = self.cameras[name].T_camera_lidar, self.frames[name]
        of_camera = [frame for frame in (parent, child) if frame in (frames.optical, frames.link)]
        if len(of_camera) != 1:
            own = f"{frames.optical} or {frames.link} (the camera: --camera-frame, --camera-link)"
            others = f"{self.options.lidar_frame} (the LiDAR: --lidar-frame) or a frame of --tree"
            raise ConfigError(
                f"from {parent!r} to {child!r}: expected {own} at one end, {others} at the other"
            )
        linkTc = self.link_from_optical(name) if of_camera[0] == frames.link else gtsam.Pose3()
        other = child if of_camera[0] == parent else parent
        vTl, cameraTl = self.lidar_in(other, "of the vehicle"), linkTc * cTl
        return cameraTl * vTl.inverse() if of_camera[0] == parent else vTl * cameraTl.inverse()


def rig_of(cameras: Mapping[str, CalibrationResult], options: ExportOptions, several: bool) -> Rig:
    """The cameras with the names of their frames.

    Raises:
        ConfigError: two cameras have one frame.
    """
    usual = f"{CAMERA}_optical_frame" if several else "camera_optical_frame"
    frames: dict[str, CameraFrames] = {}
    for number, (name, plain) in enumerate(folder_names(dict(cameras)).items()):
        optical = filled(options.camera_frame or usual, plain, number)
        link = filled(options.camera_link or f"{optical.removesuffix('_optical_frame')}_link", plain, number)
        frames[name] = CameraFrames(optical, link)
    optical_names = [one.optical for one in frames.values()]
    if len(set(optical_names)) < len(optical_names):
        raise ConfigError(
            f"camera frame {optical_names[0]!r}: found for several cameras, expected {CAMERA} in it"
        )
    return Rig(cameras, frames, options, several)


def _listed(frames: Sequence[str]) -> str:
    return ", ".join(frames[:12]) + (", ..." if len(frames) > 12 else "")


def filled(frame: str, name: str, number: int) -> str:
    """The name of a frame with the camera's name and number in it."""
    return frame.replace(CAMERA, folder_names((name,))[name]).replace(NUMBER, str(number))
