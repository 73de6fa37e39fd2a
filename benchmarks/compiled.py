"""The hot paths as fused loops compiled by numba (extra ``bench``), for comparison: one pass over the
matches, no array between the steps.

They give what the package gives (``ratios.py`` compares the results), on the inputs of its production path:
whole scans that share one time, pinhole images, contours of masks, static objects. What others then take,
gtsam's linear factor or frozen matches, is made by the same constructors; ``alone`` are the loops without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.association.edge_matching import (
    _MIN_COSINE,
    BOTTOM,
    GATE,
    LOWER_EDGE_SIGMA_PX,
    MIN_OBJECT_SHARE,
    SIDE_OF,
    SIDES,
    TOP,
    EdgeMatches,
    MatchConfig,
    PairedEdges,
    level_sigmas,
)
from sst_graph.association.nearest import ClassView, NearestMatches, frozen
from sst_graph.factors import Alignment, PinholeCamera, RobustKernel, Vector, custom_factor
from sst_graph.factors.camera import MIN_DEPTH_M
from sst_graph.features.mask_contour import BORDER_PX, MIN_GRADIENT, ContourMap
from sst_graph.graph.frozen_problem import FrozenPoint, FrozenProblem, NormalEquations

try:
    from numba import njit
except ImportError as error:
    raise SystemExit("numba is missing: pip install 'sst-graph[bench]'") from error

FloatArray = NDArray[np.float64]
_TOP, _BOTTOM = int(TOP), int(BOTTOM)


def _camera(camera: PinholeCamera) -> FloatArray:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height], np.float64)


@njit(cache=True)
def _moved(R: FloatArray, t: FloatArray, xi: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Exp(xi) . (R, t)."""
    x = xi[0] * xi[0] + xi[1] * xi[1] + xi[2] * xi[2]
    if x < 1e-8:
        a, b, c = 1.0 - x / 6.0, 0.5 - x / 24.0, 1.0 / 6.0 - x / 120.0
    else:
        s = np.sqrt(x)
        a, b, c = np.sin(s) / s, (1.0 - np.cos(s)) / x, (s - np.sin(s)) / (x * s)
    W = np.array([[0.0, -xi[2], xi[1]], [xi[2], 0.0, -xi[0]], [-xi[1], xi[0], 0.0]])
    turned, shifted = np.empty((3, 3)), np.empty(3)
    for i in range(3):
        for j in range(3):
            WW = W[i, 0] * W[0, j] + W[i, 1] * W[1, j] + W[i, 2] * W[2, j]
            turned[i, j] = (i == j) + a * W[i, j] + b * WW
        total = 0.0
        for j in range(3):
            WW = W[i, 0] * W[0, j] + W[i, 1] * W[1, j] + W[i, 2] * W[2, j]
            total += ((i == j) + b * W[i, j] + c * WW) * xi[3 + j]
        shifted[i] = total
    moved_R, moved_t = np.zeros((3, 3)), shifted
    for i in range(3):
        for k in range(3):
            moved_t[i] += turned[i, k] * t[k]
            for j in range(3):
                moved_R[i, j] += turned[i, k] * R[k, j]
    return moved_R, moved_t


@njit(cache=True)
def _lift(R: FloatArray, t: FloatArray, xi: FloatArray, rate: FloatArray, tau: float) -> FloatArray:
    """(13, 6) from a wrench [cP x g; g] to the derivatives by cTl, time offset and twist."""
    lift, ad, left = np.zeros((13, 6)), np.zeros((6, 6)), np.eye(6)
    T = np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]])
    for i in range(3):
        for j in range(3):
            lift[i, j] = lift[3 + i, 3 + j] = R[j, i]
            for k in range(3):
                lift[i, 3 + j] += T[j, k] * R[k, i]
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        for row, column, part in ((0, 0, 0), (3, 3, 0), (3, 0, 3)):
            ad[row + j, column + k], ad[row + k, column + j] = -xi[part + i], xi[part + i]
    power, factorial = np.eye(6), 1.0
    for order in range(1, 9):
        following = np.zeros((6, 6))
        for i in range(6):
            for k in range(6):
                for j in range(6):
                    following[i, j] += power[i, k] * ad[k, j]
        power = following
        factorial *= order + 1.0
        left += power / factorial
    for i in range(6):
        for j in range(6):
            lift[6, i] -= left[i, j] * rate[j]
            lift[7 + i, j] = -tau * left[j, i]
    return lift


@njit(cache=True)
def _frame_products(
    lPs: FloatArray,
    pixels: FloatArray,
    scales: FloatArray,
    kernel_px: float,
    camera: FloatArray,
    pose: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, float]:
    """(7, 7) sum of the products of wrenches and residual, and the cost, of point-to-pixel matches."""
    S, cost = np.zeros((7, 7)), 0.0
    R, t = pose
    fx, fy, cx, cy, diagonal = camera[0], camera[1], camera[2], camera[3], np.hypot(camera[4], camera[5])
    u, v = np.zeros(7), np.zeros(7)
    for i in range(len(lPs)):
        a, b, c = lPs[i, 0], lPs[i, 1], lPs[i, 2]
        X = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + t[0]
        Y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + t[1]
        Z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + t[2]
        if Z <= MIN_DEPTH_M:
            z = (diagonal * scales[i] / kernel_px) ** 2
            cost += 0.5 * kernel_px**2 * z / (1.0 + z)
            continue
        inverse = 1.0 / Z
        x, y = X * inverse, Y * inverse
        ru, rv = fx * x + cx - pixels[i, 0], fy * y + cy - pixels[i, 1]
        z = (ru * ru + rv * rv) * (scales[i] / kernel_px) ** 2
        cost += 0.5 * kernel_px**2 * z / (1.0 + z)
        w = scales[i] / (1.0 + z)
        gu, gv = w * fx * inverse, w * fy * inverse
        # Rows [cP x g; g; r] of u and v.
        u[0], u[1], u[2], u[3], u[5], u[6] = -Y * gu * x, Z * gu + X * gu * x, -Y * gu, gu, -gu * x, w * ru
        v[0], v[1], v[2], v[4], v[5], v[6] = -Y * gv * y - Z * gv, X * gv * y, X * gv, gv, -gv * y, w * rv
        for j in range(7):
            for k in range(j + 1):
                S[j, k] += u[j] * u[k] + v[j] * v[k]
    for j in range(7):
        for k in range(j):
            S[k, j] = S[j, k]
    return S, cost


@njit(cache=True)
def _frame_system(
    matches: tuple[FloatArray, FloatArray, FloatArray, float, FloatArray],
    pose: tuple[FloatArray, FloatArray],
    twist: FloatArray,
    tau: float,
) -> tuple[FloatArray, FloatArray]:
    """Error (8,) and Jacobian (8, 13) of the same cost, gradient and Hessian as all matches."""
    lPs, pixels, scales, kernel_px, camera = matches
    xi = -tau * twist
    R, t = _moved(pose[0], pose[1], xi)
    S, cost = _frame_products(lPs, pixels, scales, kernel_px, camera, (R, t))
    root, lift = np.linalg.cholesky(S), _lift(R, t, xi, twist, tau)
    error, J = np.zeros(8), np.zeros((8, 13))
    for k in range(7):
        error[k] = root[6, k]
        for i in range(13):
            for j in range(6):
                J[k, i] += lift[i, j] * root[j, k]
    error[7] = np.sqrt(max(2.0 * cost - S[6, 6], 0.0))
    return error, J


class CompiledFrame:
    """Alignments of one image that share one time, as their frame factor."""

    def __init__(self, alignments: Sequence[Alignment]) -> None:
        first = alignments[0]
        taus = {alignment.common_tau_s for alignment in alignments}
        assert len(taus) == 1 and None not in taus and first.kernel.kind == "geman_mcclure"
        assert all((a.weights == 1.0).all() and a.kernel == first.kernel for a in alignments)
        self._tau_s = taus.pop()
        self._matches = (
            np.concatenate([a.lPs for a in alignments]),
            np.concatenate([a.pixels for a in alignments]),
            np.concatenate([1.0 / a.sigmas_px for a in alignments]),
            first.kernel.scale,
            _camera(first.camera),
        )

    def alone(self, cTl: gtsam.Pose3, time_offset_s: float, c_twist: FloatArray) -> tuple[Any, Any]:
        """Error and Jacobian."""
        R, t = np.ascontiguousarray(cTl.rotation().matrix()), np.asarray(cTl.translation())
        found = _frame_system(self._matches, (R, t), c_twist, time_offset_s + self._tau_s)
        return found[0], found[1]

    def factor(self, E: int, D: int, V: int) -> gtsam.CustomFactor:
        """On extrinsic, time offset and twist."""

        def function(
            cTl: gtsam.Pose3, time_offset_s: FloatArray, c_twist: FloatArray, *, jacobians: bool
        ) -> tuple[FloatArray, list[FloatArray]]:
            error, J = self.alone(cTl, float(time_offset_s[0]), c_twist)
            return error, [J[:, :6], J[:, 6:7], J[:, 7:]]

        kinds = [gtsam.Pose3, Vector(1), Vector(6)]
        return custom_factor(gtsam.noiseModel.Unit.Create(8), [E, D, V], function, kinds, 8)


@njit(cache=True)
def _add_matches(
    matches: tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray],
    cells: NDArray[np.int64],
    taus: FloatArray,
    twists: FloatArray,
    accelerations: FloatArray,
    biases_px: FloatArray,
    pose: tuple[FloatArray, FloatArray],
    setting: tuple[FloatArray, float, int],
    system: tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray],
) -> float:
    """Add silhouettes to the normal equations; their cost.

    Args:
        matches: points, pixels, normals, sigmas, weights.
        cells: (c, 4) first match, end, image and column of the bias of the matches that share these.
    """
    lPs, pixels, normals, sigmas, weights = matches
    camera, kernel_px, clock = setting
    H, g, H_twists, g_twists, H_mixed = system
    fx, fy, cx, cy, diagonal = camera[0], camera[1], camera[2], camera[3], np.hypot(camera[4], camera[5])
    cost, row, n = 0.0, np.empty(8), len(g)
    L, last, R, t = np.zeros((13, 6)), -1, np.zeros((3, 3)), np.zeros(3)
    for cell in range(len(cells)):
        start, end, image, bias = cells[cell]
        if image != last:  # its points move as one rigid body
            tau, last = taus[start], image
            xi = -tau * (twists[image] - 0.5 * tau * accelerations[start])
            R, t = _moved(pose[0], pose[1], xi)
            L = _lift(R, t, xi, twists[image] - tau * accelerations[start], tau)
        S = np.zeros((8, 8))
        for i in range(start, end):
            a, b, c = lPs[i, 0], lPs[i, 1], lPs[i, 2]
            X = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + t[0]
            Y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + t[1]
            Z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + t[2]
            if Z <= MIN_DEPTH_M:
                z = (diagonal / (sigmas[i] * kernel_px)) ** 2
                cost += weights[i] * 0.5 * kernel_px**2 * z / (1.0 + z)
                continue
            inverse = 1.0 / Z
            x, y = X * inverse, Y * inverse
            r = normals[i, 0] * (fx * x + cx - pixels[i, 0]) + normals[i, 1] * (fy * y + cy - pixels[i, 1])
            r += biases_px[bias - 6]
            z = (r / (sigmas[i] * kernel_px)) ** 2
            cost += weights[i] * 0.5 * kernel_px**2 * z / (1.0 + z)
            w = np.sqrt(weights[i]) / (sigmas[i] * (1.0 + z))
            gx, gy = w * normals[i, 0] * fx * inverse, w * normals[i, 1] * fy * inverse
            gz = -(gx * x + gy * y)
            row[0], row[1], row[2] = Y * gz - Z * gy, Z * gx - X * gz, X * gy - Y * gx
            row[3], row[4], row[5], row[6], row[7] = gx, gy, gz, w, w * r
            for j in range(8):
                for k in range(j + 1):
                    S[j, k] += row[j] * row[k]
        for j in range(8):
            for k in range(j):
                S[k, j] = S[j, k]
        LS = np.zeros((13, 8))
        for i in range(13):
            for k in range(6):
                for j in range(8):
                    LS[i, j] += L[i, k] * S[k, j]
        for i in range(13):
            place = i if i < 6 else clock
            for j in range(13):
                total = 0.0
                for k in range(6):
                    total += LS[i, k] * L[j, k]
                other = j if j < 6 else clock
                if i < 7 and j < 7:
                    H[place, other] += total
                elif i >= 7 and j >= 7:
                    H_twists[image, i - 7, j - 7] += total
                elif i >= 7:
                    H_mixed[image, i - 7, other] += total
            if i < 7:
                H[place, bias] += LS[i, 6]
                H[bias, place] += LS[i, 6]
                g[place] += LS[i, 7]
            else:
                H_mixed[image, i - 7, bias] += LS[i, 6]
                g_twists[image, i - 7] += LS[i, 7]
        H[bias, bias] += S[6, 6]
        g[bias] += S[6, 7]
    assert n >= 7
    return cost


class CompiledProblem(FrozenProblem):
    """The frozen problem with the compiled loop in place of the array code for the matches."""

    def _add(self, frames: Any, system: NormalEquations, point: FrozenPoint) -> float:
        alignment, first = frames.alignment, frames.cells
        assert not self._terms and alignment.l_velocities is None and alignment.stretches is None
        assert alignment.kernel.kind == "geman_mcclure"
        if not hasattr(self, "_cells"):  # they stay for all linearizations
            bounds = np.append(first, len(alignment))
            columns = [bounds[:-1], bounds[1:], frames.images[first], frames.biases[first]]
            self._cells = np.ascontiguousarray(np.stack(columns, axis=1), np.int64)
            each = np.broadcast_to(alignment.c_acceleration, (len(alignment), 6))
            self._accelerations = np.ascontiguousarray(each)
        R, t = np.ascontiguousarray(point.cTl.rotation().matrix()), np.asarray(point.cTl.translation())
        return float(
            _add_matches(
                (alignment.lPs, alignment.pixels, alignment.normals, alignment.sigmas_px, alignment.weights),
                self._cells,
                float(point.scalars[frames.clock - 6]) + alignment.base_taus_s,
                point.twists,
                self._accelerations,
                point.scalars,
                (R, t),
                (_camera(alignment.camera), alignment.kernel.scale, frames.clock),
                (system.H, system.g, system.H_twists, system.g_twists, system.H_mixed),
            )
        )


@njit(cache=True)
def _at(field: FloatArray, start: int, rows: int, columns: int, u: float, v: float) -> float:
    """Bilinear value; the border is extended."""
    c, r = int(np.floor(u)), int(np.floor(v))
    a, b = u - c, v - r
    c0, c1 = min(max(c, 0), columns - 1), min(max(c + 1, 0), columns - 1)
    r0, r1 = start + min(max(r, 0), rows - 1) * columns, start + min(max(r + 1, 0), rows - 1) * columns
    top = (1.0 - a) * field[r0 + c0] + a * field[r0 + c1]
    return (1.0 - b) * top + b * ((1.0 - a) * field[r1 + c0] + a * field[r1 + c1])


@njit(cache=True)
def _match(
    points: tuple[FloatArray, FloatArray, NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64]],
    bounds: NDArray[np.int64],
    poses: tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray],
    fields: tuple[FloatArray, NDArray[np.uint8], NDArray[np.int64]],
    biases_px: FloatArray,
    setting: tuple[FloatArray, FloatArray, NDArray[np.int64]],
) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray, NDArray[np.int64]]:
    """Numbers and sides (m,) of the matches, their pixel, normal, sigma, weight (m, 6), and points in view by
    group."""
    lPs, outward, edges, owners, rings = points
    R0, t0, taus, twists, accelerations = poses
    distance, unknown, boxes = fields
    camera, (gate, mask_sigma, side_sigma, lower_sigma, min_share), side_of = setting
    fx, fy, cx, cy, width, height = camera
    n, count = len(lPs), owners.max() + 1
    index, sides, found = np.empty(n, np.int64), np.empty(n, np.int64), np.empty((n, 6))
    seen, met, in_view = np.zeros(count), np.zeros(count), np.zeros(len(bounds) - 1, np.int64)
    m, border = 0, BORDER_PX
    for group in range(len(bounds) - 1):
        if bounds[group] == bounds[group + 1]:
            continue
        tau = taus[group]
        R, t = _moved(R0, t0, -tau * (twists[group] - 0.5 * tau * accelerations[group]))
        start, left, top, columns, rows = boxes[group]
        for i in range(bounds[group], bounds[group + 1]):
            a, b, c = lPs[i, 0], lPs[i, 1], lPs[i, 2]
            Z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + t[2]
            if Z <= MIN_DEPTH_M:
                continue
            u = fx * (R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + t[0]) / Z + cx
            v = fy * (R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + t[1]) / Z + cy
            if not (-0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5):
                continue
            in_view[group] += 1
            seen[owners[i]] += 1.0
            if not (border < u < width - 1 - border and border < v < height - 1 - border):
                continue
            x, y = u - left, v - top
            centre = _at(distance, start, rows, columns, x, y)
            gx = _at(distance, start, rows, columns, x + 1.0, y)
            gx = 0.5 * (gx - _at(distance, start, rows, columns, x - 1.0, y))
            gy = _at(distance, start, rows, columns, x, y + 1.0)
            gy = 0.5 * (gy - _at(distance, start, rows, columns, x, y - 1.0))
            length = np.sqrt(gx * gx + gy * gy)
            if length <= MIN_GRADIENT or abs(centre + biases_px[group]) >= gate:
                continue
            gx, gy = gx / length, gy / length
            foot_x, foot_y = u - centre * gx, v - centre * gy
            column = min(max(int(np.rint(foot_x - left)), 0), columns - 1)
            if unknown[start + min(max(int(np.rint(foot_y - top)), 0), rows - 1) * columns + column]:
                continue
            a, b, c = outward[i, 0], outward[i, 1], outward[i, 2]
            Z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + t[2]
            out_x = fx * (R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + t[0]) / Z + cx - u
            out_y = fy * (R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + t[1]) / Z + cy - v
            far = np.sqrt(out_x * out_x + out_y * out_y)
            cosine = (out_x * gx + out_y * gy) / max(far, 1e-9)
            if cosine <= _MIN_COSINE:
                continue
            met[owners[i]] += 1.0
            index[m], sides[m] = i, side_of[edges[i], 1 if out_x > 0.0 else 0]
            found[m, 0], found[m, 1], found[m, 2], found[m, 3] = foot_x, foot_y, gx, gy
            found[m, 4] = np.hypot(mask_sigma, 0.5 * far * cosine / np.sqrt(3.0))
            m += 1
    layers = rings.max() + 1
    information, of_rings, kept = np.zeros(4 * count), np.zeros(4 * count * layers), 0
    for k in range(m):
        owner = owners[index[k]]
        if met[owner] >= min_share * seen[owner]:
            index[kept], sides[kept], found[kept] = index[k], sides[k], found[k]
            side, own = 4 * owner + sides[kept], found[kept, 4] ** -2.0
            information[side] += own
            of_rings[side * layers + rings[index[kept]]] += own
            kept += 1
    for k in range(kept):
        side = 4 * owners[index[k]] + sides[k]
        shared = lower_sigma if sides[k] == _BOTTOM else side_sigma
        total = information[side] * shared**2
        if sides[k] >= _TOP:
            sampling = found[k, 4] ** 2 - mask_sigma**2
            total += of_rings[side * layers + rings[index[k]]] * sampling
        found[k, 5] = 1.0 / (1.0 + total)
    return index[:kept], sides[:kept], found[:kept], in_view


class CompiledEdges:
    """Paired edges, matched as :func:`sst_graph.association.edge_matching.match_edges` does."""

    def __init__(self, paired: PairedEdges, kernel: RobustKernel, config: MatchConfig) -> None:
        assert SIDES == 4 and paired.velocities is None
        maps = [contour for contour in paired.contours if isinstance(contour, ContourMap)]
        assert len(maps) == len(paired.contours) and all(each.stretch is None for each in maps)
        self._paired, self._kernel, self._config = paired, kernel, config
        points, starts = paired.points, [min(a, len(paired.points) - 1) for a, _ in paired.spans]
        assert all((paired.base_taus_s[a:b] == paired.base_taus_s[a:b][:1]).all() for a, b in paired.spans)
        rings = points.rings.astype(np.int64)
        self._points = points.lPs, points.outward, points.edges, paired.owners, rings
        self._bounds, self._base_taus_s = paired.bounds, paired.base_taus_s[starts]
        motion, shape = paired.motion, (len(paired.contours), 6)
        self._twists = np.array(np.broadcast_to(motion.c_twist, shape))
        self._accelerations = np.array(np.broadcast_to(motion.c_acceleration, shape))
        distances = [np.asarray(each.distance) for each in maps]
        firsts = np.cumsum([0, *(each.size for each in distances)])[:-1]
        self._fields = (
            np.concatenate([each.reshape(-1) for each in distances]),
            np.concatenate([np.asarray(each.unknown).reshape(-1) for each in maps]),
            np.array([(at, each.left, each.top, *each.box) for at, each in zip(firsts, maps, strict=True)]),
        )
        self._biases_px = paired.biases_px
        limits = GATE * kernel.scale, config.mask_sigma_px, config.side_sigma_px
        self._setting = (
            _camera(paired.camera),
            np.array([*limits, LOWER_EDGE_SIGMA_PX, MIN_OBJECT_SHARE]),
            SIDE_OF.astype(np.int64),
        )

    def alone(self, cTl: gtsam.Pose3, time_offset_s: float) -> tuple[Any, ...]:
        """As ``_match``."""
        R, t = np.ascontiguousarray(cTl.rotation().matrix()), np.asarray(cTl.translation())
        taus = time_offset_s + self._base_taus_s
        poses = R, t, taus, self._twists, self._accelerations
        return tuple(_match(self._points, self._bounds, poses, self._fields, self._biases_px, self._setting))

    def match(self, cTl: gtsam.Pose3, time_offset_s: float) -> EdgeMatches:
        """As ``match_edges`` gives them."""
        index, sides, found, seen = self.alone(cTl, time_offset_s)
        bounds = np.searchsorted(index, self._bounds)
        alignment = Alignment(
            camera=self._paired.camera,
            lPs=self._points[0][index],
            base_taus_s=self._paired.base_taus_s[index],
            pixels=found[:, :2],
            sigmas_px=found[:, 4],
            normals=found[:, 2:4],
            kernel=self._kernel,
            c_acceleration=np.repeat(self._accelerations, np.diff(bounds), axis=0),
            weights=found[:, 5],
        )
        level_px = level_sigmas(sides, found[:, 4], self._config)
        return EdgeMatches(index, sides, alignment, bounds, seen, np.ones(len(index)), level_px)


@njit(cache=True)
def _nearest(
    lPs: FloatArray,
    pose: tuple[FloatArray, FloatArray],
    camera: FloatArray,
    index: NDArray[np.int32],
    pixels: FloatArray,
    cell: float,
) -> tuple[NDArray[np.int64], FloatArray, FloatArray, NDArray[np.int64]]:
    """Points on the image, their pixels and nearest pixels of the class, and the point nearest to each pixel,
    by a grid of square cells."""
    R, t = pose
    fx, fy, cx, cy, width, height = camera
    on, uvs, targets = np.empty(len(lPs), np.int64), np.empty((len(lPs), 2)), np.empty((len(lPs), 2))
    m, columns = 0, index.shape[1]
    for i in range(len(lPs)):
        a, b, c = lPs[i, 0], lPs[i, 1], lPs[i, 2]
        Z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + t[2]
        if Z <= MIN_DEPTH_M:
            continue
        u = fx * (R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + t[0]) / Z + cx
        v = fy * (R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + t[1]) / Z + cy
        if not (-0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5):
            continue
        place = index[int(v + 0.5), int(u + 0.5)]
        on[m], uvs[m, 0], uvs[m, 1] = i, u, v
        targets[m, 0], targets[m, 1] = place % columns, place // columns
        m += 1
    across, down = int(width / cell) + 1, int(height / cell) + 1
    counts, cells = np.zeros(across * down + 1, np.int64), np.empty(m, np.int64)
    for i in range(m):
        cells[i] = int((uvs[i, 1] + 0.5) / cell) * across + int((uvs[i, 0] + 0.5) / cell)
        counts[cells[i] + 1] += 1
    firsts = np.cumsum(counts)
    ends, order = firsts[:-1].copy(), np.empty(m, np.int64)
    for i in range(m):
        order[ends[cells[i]]] = i
        ends[cells[i]] += 1
    chosen = np.empty(len(pixels), np.int64)
    for j in range(len(pixels)):
        u, v = pixels[j]
        column, row = int((u + 0.5) / cell), int((v + 0.5) / cell)
        best, nearest, ring = np.inf, -1, 0
        while ring <= across + down and (nearest < 0 or best > ((ring - 1) * cell) ** 2):
            for r in range(max(row - ring, 0), min(row + ring, down - 1) + 1):
                step = 1 if abs(r - row) == ring or ring == 0 else 2 * ring
                for c in range(column - ring, column + ring + 1, step):
                    if 0 <= c < across:
                        for k in range(firsts[r * across + c], firsts[r * across + c + 1]):
                            i = order[k]
                            far = (uvs[i, 0] - u) ** 2 + (uvs[i, 1] - v) ** 2
                            if far < best:
                                best, nearest = far, i
            ring += 1
        chosen[j] = nearest
    return on[:m], uvs[:m], targets[:m], chosen


class CompiledNearest:
    """Matches in both directions as :func:`sst_graph.association.nearest.match_nearest` makes them."""

    def __init__(self, view: ClassView) -> None:
        self._view, self._camera = view, _camera(view.camera)

    def alone(
        self, cTl: gtsam.Pose3, time_offset_s: float, c_twist: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Points and their pixels, and the points nearest to the view's pixels."""
        view = self._view
        R = np.ascontiguousarray(cTl.rotation().matrix())
        t = np.asarray(cTl.translation()) - (time_offset_s + view.base_tau_s) * c_twist[3:]
        on, _, targets, chosen = _nearest(
            view.lPs, (R, t), self._camera, view.nearest.index, view.pixels, 12.0
        )
        lPs = view.lPs[on]
        return lPs, targets, lPs[chosen]

    def match(
        self, cTl: gtsam.Pose3, time_offset_s: float, c_twist: FloatArray, pixel_weight: float
    ) -> NearestMatches:
        """As ``match_nearest`` gives them."""
        lPs, targets, chosen = self.alone(cTl, time_offset_s, c_twist)
        weight = pixel_weight * len(lPs) / len(self._view.pixels)
        return NearestMatches(
            frozen(self._view, lPs, targets, 1.0), frozen(self._view, chosen, self._view.pixels, weight)
        )
