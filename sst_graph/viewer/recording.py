"""A recording for rerun: saved to a file, shown live, or both. docs/how-to/viewer.md lists its entities.

Needs rerun-sdk (the extra ``rerun``), imported when a recording begins.
"""

from __future__ import annotations

import os
import socket
import sys
from collections import deque
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import ConfigError, one_line, optional_module
from sst_graph.factors.camera import PinholeCamera
from sst_graph.inspect.inspection import HUMAN
from sst_graph.sampling import step_for
from sst_graph.tracker.track_update import TrackUpdate, unconfirmed_sentences
from sst_graph.types import Calibration, FloatArray, SemanticClass
from sst_graph.viewer.frame_view import FrameView, MatchView
from sst_graph.viewer.recorded_file import RecordedFile
from sst_graph.viz.overlay import CLASS_COLOURS, IN_MASK, OTHER_COLOUR

LIDAR = "world/lidar"
CAMERA = f"{LIDAR}/camera"
IMAGE = f"{CAMERA}/image"

UNKNOWNS = (
    *(f"{group}/{axis}" for group in ("rotation", "translation") for axis in "xyz"),
    "time_offset/offset",
)
"""Entities of the seven unknowns, below ``estimate`` and ``sigma``: degrees, centimetres, milliseconds."""
_AXES = (230, 80, 80), (90, 190, 90), (80, 140, 250)
"""Colours of x, y and z."""

FRAME_TIMELINE, TIME_TIMELINE = "frame", "drive_time"

_MOST_POINTS = 60_000
"""Points of a cloud that are shown; of more, every second, third, ..."""
_MOST_POSES = 5_000
"""Latest poses of the trajectory."""
_LONGEST_FLUSH_S = 60.0
"""The viewer that takes nothing for so long has gone."""
_JPEG_QUALITY = 85
_SCREENS = "DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"
"""Variables of the environment by which a window finds its screen on Linux."""
_VIEWER_ADDRESS = "127.0.0.1", 9876
"""Where a viewer listens; one that is open already is used."""
_DEPTHS_M = 3.0, 60.0
"""Depths at the ends of the colours."""
_WORST_PX = 5.0
"""Residual at the end of the colours [px]."""


def rerun() -> Any:
    """The module rerun.

    Raises:
        MissingDependencyError: it is not installed.
    """
    without = "the viewer needs rerun-sdk, which is not installed"
    optional_module("rerun.blueprint", without, "rerun")
    return optional_module("rerun", without, "rerun")


class Recording:
    """What is logged, in the order of the drive; closed at the end of a ``with`` block."""

    def __init__(self, camera: PinholeCamera, *, live: bool, save: Path | None, tracked: bool) -> None:
        """Begin.

        Args:
            live: open a viewer and stream into it.
            save: file to write.
            tracked: of a tracker, whose estimate and status change from frame to frame.

        Raises:
            MissingDependencyError: rerun is not installed.
            ConfigError: no viewer can be opened.
            OSError: the file cannot be written; so do the other methods.
        """
        self._rr, self._camera = rerun(), camera
        self._stream = self._rr.RecordingStream("sst-graph")
        live_sinks = self._live_sinks() if live else []
        self._file = None if save is None else RecordedFile(save)
        file_sinks = [] if self._file is None else [self._rr.FileSink(self._file.pipe)]
        try:
            self._stream.set_sinks(*file_sinks, *live_sinks, default_blueprint=_blueprint(tracked))
        finally:
            if self._file is not None:
                self._file.begin()
        self._first_ns: int | None = None
        self._path: deque[FloatArray] = deque(maxlen=_MOST_POSES)
        self._tracks: dict[int, deque[FloatArray]] = {}
        self._reference: Calibration | None = None
        self._said: tuple[object, ...] = ()
        self._log_static()

    def __enter__(self) -> Recording:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._stream.flush(timeout_sec=_LONGEST_FLUSH_S)
        except Exception as error:
            why = one_line(error)
            raise ConfigError(f"the viewer rerun has gone: {why} (without a screen, save a file)") from error
        finally:
            self._stream.disconnect()
            if self._file is not None:
                self._file.finish(_LONGEST_FLUSH_S)

    # ------------------------------------------------------------------ what is logged

    def frame(self, view: FrameView) -> None:
        """A frame: cloud, pose, picture, points in the picture, matches, tracks."""
        rr, scan = self._rr, view.scan
        if self._file is not None:
            self._file.check()
        self._at(view.number, scan.stamp_ns)
        self._log(LIDAR, _transform(rr, view.oTl))
        self._log(CAMERA, _transform(rr, view.cTl.inverse()))
        every = step_for(len(scan.points), _MOST_POINTS)
        self._log(f"{LIDAR}/cloud", rr.Points3D(scan.points[::every], class_ids=scan.classes[::every]))
        self._path.append(np.asarray(view.oTl.translation()))
        self._log("world/trajectory", rr.LineStrips3D([np.array(self._path)], colors=[(255, 200, 0)]))
        self._log_tracks(view)
        if view.image is None:
            for name in ("", "/points_by_depth", "/points_by_class", "/matches"):
                self._log(f"{IMAGE}{name}", rr.Clear(recursive=False))
            return
        if view.image.has_picture:
            quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
            data = cv2.imencode(".jpg", view.image.pixels, quality)[1]
            self._log(IMAGE, rr.EncodedImage(contents=data.tobytes(), media_type="image/jpeg"))
        colours = _turbo(np.log(view.depths_m / _DEPTHS_M[0]) / np.log(_DEPTHS_M[1] / _DEPTHS_M[0]))
        self._log(f"{IMAGE}/points_by_depth", rr.Points2D(view.uvs, colors=colours, radii=0.8))
        classes = scan.classes[view.seen]
        self._log(f"{IMAGE}/points_by_class", rr.Points2D(view.uvs, class_ids=classes, radii=0.8))
        self._log_matches(view.matches)

    def update(self, update: TrackUpdate) -> None:
        """The tracker's estimate after a frame: deviations from the first one, with 2 sigma; status."""
        if update.frame is not None:
            self._at(update.frame, update.stamp_ns)
        if self._reference is None:
            self._reference = update.calibration
        if update.covariance is not None:
            self.estimate(update.calibration, update.sigmas)
        rr = self._rr
        self._log("tracker/matches", rr.Scalars([update.matches]))
        if update.chi2 is not None:
            self._log("tracker/chi2", rr.Scalars([update.chi2]))
        said = (update.status, update.reason, update.suspected_change, update.alarm, update.adopted)
        if said != self._said:
            self._said = said
            self._log("tracker/log", rr.TextLog(_sentence(update), level=_level(update)))

    def estimate(self, calibration: Calibration, sigmas: FloatArray) -> None:
        """Extrinsic and time offset against the first ones, with 2 sigma.

        Args:
            sigmas: (7,) [rad, m, s].
        """
        if self._reference is None:
            self._reference = calibration
        change = HUMAN * self._reference.local_coordinates(calibration)
        band = 2.0 * HUMAN * sigmas
        for entity, value, width in zip(UNKNOWNS, change, band, strict=True):
            self._log(f"estimate/{entity}", self._rr.Scalars([value, value - width, value + width]))
        self.sigmas(sigmas)

    def sigmas(self, sigmas: FloatArray) -> None:
        """Standard deviations (7,) [rad, m, s] at the present time."""
        for entity, value in zip(UNKNOWNS, HUMAN * sigmas, strict=True):
            self._log(f"sigma/{entity}", self._rr.Scalars([value]))

    def sigmas_at(self, number: int, sigmas: FloatArray) -> None:
        """As :meth:`sigmas`, at a frame's number alone."""
        self._stream.reset_time()
        self._stream.set_time(FRAME_TIMELINE, sequence=number)
        self.sigmas(sigmas)

    # ------------------------------------------------------------------ how

    def _live_sinks(self) -> list[Any]:
        """What streams into a viewer, which is opened."""
        rr = self._rr
        _check_screen()
        try:
            # Without the recording, the global one is asked, and says that it is disabled.
            rr.spawn(connect=False, recording=self._stream, executable_path=_executable())
        except Exception as error:
            why = one_line(error)
            raise ConfigError(f"the viewer rerun cannot be opened: {why} (or save a file)") from error
        return [rr.GrpcSink()]

    def _log(self, path: str, *what: Any, static: bool = False) -> None:
        self._stream.log(path, *what, static=static)

    def _at(self, number: int, stamp_ns: int) -> None:
        if self._first_ns is None:
            self._first_ns = stamp_ns
        self._stream.set_time(FRAME_TIMELINE, sequence=number)
        self._stream.set_time(TIME_TIMELINE, duration=1e-9 * (stamp_ns - self._first_ns))

    def _log_static(self) -> None:
        rr, camera = self._rr, self._camera
        self._log("world", rr.ViewCoordinates.FLU, static=True)
        infos = [(int(c), c.name.lower(), _colour(c)) for c in SemanticClass]
        self._log("world", rr.AnnotationContext(infos), static=True)
        size = [camera.width, camera.height]
        self._log(
            IMAGE,
            rr.Pinhole(
                image_from_camera=camera.matrix,
                resolution=size,
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=4.0,
            ),
            static=True,
        )
        for entity, colour in zip(UNKNOWNS, (*_AXES, *_AXES, _AXES[2]), strict=True):
            name, lighter = entity.rpartition("/")[2], [(255 + part) // 2 for part in colour]
            names = [name, f"{name} - 2 sigma", f"{name} + 2 sigma"]
            lines = rr.SeriesLines(names=names, colors=[colour, lighter, lighter], widths=[2.0, 0.7, 0.7])
            self._log(f"estimate/{entity}", lines, static=True)
            self._log(f"sigma/{entity}", rr.SeriesLines(names=[name], colors=[colour]), static=True)

    def _log_tracks(self, view: FrameView) -> None:
        for track, (_, centre) in view.tracks.items():
            self._tracks.setdefault(track, deque(maxlen=_MOST_POSES)).append(centre)
        for gone in [track for track in self._tracks if track not in view.tracks]:
            del self._tracks[gone]
        rr, shown = self._rr, sorted(view.tracks)
        centres = np.array([view.tracks[track][1] for track in shown]).reshape(-1, 3)
        classes = [int(view.tracks[track][0]) for track in shown]
        labels = [f"{view.tracks[track][0].name.lower()} {track}" for track in shown]
        self._log("world/tracks", rr.Points3D(centres, class_ids=classes, labels=labels, radii=0.15))
        strips = [np.array(self._tracks[track]) for track in shown if len(self._tracks[track]) > 1]
        self._log("world/tracks/paths", rr.LineStrips3D(strips))

    def _log_matches(self, matches: MatchView | None) -> None:
        rr, path = self._rr, f"{IMAGE}/matches"
        if matches is None:
            self._log(path, rr.Clear(recursive=True))
            return
        colours = _turbo(np.abs(matches.residuals_px) / _WORST_PX)
        lines = np.stack([matches.boundary, matches.contour], axis=1)
        self._log(f"{path}/residuals", rr.LineStrips2D(lines, colors=colours, radii=0.8, draw_order=40.0))
        self._log(
            f"{path}/boundary_points",
            rr.Points2D(matches.boundary, colors=colours, radii=2.0, draw_order=41.0),
        )
        self._log(
            f"{path}/contour_points",
            rr.Points2D(matches.contour, colors=(255, 255, 255), radii=1.0, draw_order=42.0),
        )
        self._log("fit/residual_px", rr.Scalars([float(np.median(np.abs(matches.residuals_px)))]))


def _check_screen() -> None:
    """A viewer without a screen ends seconds after it has been started, and says so to nobody.

    Raises:
        ConfigError: there is no screen, and no viewer is open.
    """
    if sys.platform != "linux" or any(os.environ.get(name) for name in _SCREENS):
        return
    try:
        socket.create_connection(_VIEWER_ADDRESS, timeout=1.0).close()
    except OSError:
        found = (
            f"the viewer rerun cannot be opened: there is no screen (none of {', '.join(_SCREENS)} is set)"
        )
        raise ConfigError(
            f"{found}: save a file, or open a viewer first, such as rerun --serve-web"
        ) from None


def _executable() -> str | None:
    """The viewer installed beside this Python, whose folder need not be on the PATH; None: the PATH's."""
    beside = Path(sys.executable).with_name("rerun")
    return str(beside) if beside.is_file() else None


def _blueprint(tracked: bool) -> Any:
    """Space and picture above, curves and messages below."""
    from rerun import blueprint as rrb

    picture = [f"{IMAGE}/**", f"- {IMAGE}/points_by_class"]
    above = [
        rrb.Spatial3DView(origin="world", name="Space"),
        rrb.Spatial2DView(origin=IMAGE, contents=picture, name="Picture"),
    ]
    units = (("rotation", "deg"), ("translation", "cm"), ("time_offset", "ms"))
    sigmas = [
        rrb.TimeSeriesView(origin=f"sigma/{group}", name=f"Sigma of {group.replace('_', ' ')} [{unit}]")
        for group, unit in units
    ]
    fit = rrb.TimeSeriesView(origin="fit", name="Median distance to the contour [px]")
    below: list[Any] = [*sigmas, fit]
    if tracked:
        below = [
            rrb.TimeSeriesView(
                origin=f"estimate/{group}",
                name=f"{group.replace('_', ' ')} - start, 2 sigma [{unit}]",
                plot_legend=rrb.PlotLegend(visible=False),  # nine entries would hide the curves
            )
            for group, unit in units
        ]
        below.append(rrb.Tabs(rrb.TextLogView(origin="tracker", name="Status"), *sigmas, fit))
    rows = rrb.Vertical(rrb.Horizontal(*above), rrb.Horizontal(*below), row_shares=[3, 2])
    return rrb.Blueprint(rows, collapse_panels=True)


def _transform(rr: Any, aTb: gtsam.Pose3) -> Any:
    return rr.Transform3D(translation=aTb.translation(), mat3x3=aTb.rotation().matrix())


def _colour(c: SemanticClass) -> tuple[int, int, int]:
    """RGB of a class, as in the overlays."""
    blue, green, red = IN_MASK if c == SemanticClass.VEHICLE else CLASS_COLOURS.get(c, OTHER_COLOUR)
    return red, green, blue


def _turbo(shares: FloatArray) -> NDArray[np.uint8]:
    """(n, 3) RGB from blue (0) to red (1)."""
    steps = np.clip(255.0 * np.nan_to_num(shares), 0, 255).astype(np.uint8).reshape(-1, 1)
    if not len(steps):
        return np.zeros((0, 3), np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(steps, cv2.COLORMAP_TURBO)[:, 0, ::-1])


def _sentence(update: TrackUpdate) -> str:
    parts = [update.status, update.reason, *unconfirmed_sentences(update), update.undecided_sweep]
    parts += ["alarm: the calibration has changed"] * update.alarm + ["adopted"] * update.adopted
    return "; ".join(part for part in parts if part)


def _level(update: TrackUpdate) -> str:
    if update.alarm or update.status in ("alarm", "contradicted"):
        return "ERROR"
    return "INFO" if update.status == "ok" else "WARN"
