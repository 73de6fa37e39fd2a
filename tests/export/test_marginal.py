"""The marginal on (E, D): what it says, in another process, and fused."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from stored import simulated
from wrong_objects import WRONG

from sst_graph.drive.preparation import PrepareConfig, prepare_drive
from sst_graph.errors import ContradictionError, DataError, EstimationError, SstGraphError
from sst_graph.export import (
    EXTRINSIC,
    TIME_OFFSET,
    CalibrationMarginal,
    Common,
    fuse_graphs,
    fuse_marginals,
    marginal_of_graph,
    marginal_of_result,
    read_marginal,
)
from sst_graph.factors import Alignment, FactorError, RobustKernel, frame_factor, residuals, time_offset_prior
from sst_graph.factors.camera import PinholeCamera
from sst_graph.graph.building import joint_graph
from sst_graph.graph.drive_motion import motions_of
from sst_graph.graph.matching import GraphConfig, associate
from sst_graph.graph.state import State
from sst_graph.result import CalibrationResult
from sst_graph.simulator import SimulationConfig
from sst_graph.types import Calibration, SemanticClass

CAMERA = PinholeCamera(718.0, 718.0, 607.0, 185.0, 1242, 375)
FORWARD = gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
TRUE = gtsam.Pose3(FORWARD, np.array([0.06, -0.08, -0.27]))
OFFSET_S = 0.07


def covariance(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(7, 12)) * np.array([0.002] * 3 + [0.02] * 3 + [0.004])[:, None]
    return np.asarray(A @ A.T / 12.0)


def marginal(seed: int) -> CalibrationMarginal:
    d = np.random.default_rng(seed + 100).multivariate_normal(np.zeros(7), covariance(seed))
    result = CalibrationResult(TRUE.retract(d[:6]), OFFSET_S + d[6], covariance(seed), "ok", CAMERA)
    return marginal_of_result(result)


def drive(seed: int, frames: int = 6) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """A drive's frozen graph: its own twists and mask bias, the shared E and D; and a common point."""
    rng = np.random.default_rng(seed)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(EXTRINSIC, TRUE.retract(np.full(6, 0.01)))
    values.insert(TIME_OFFSET, np.array([OFFSET_S + 0.01]))
    bias = gtsam.symbol("B", seed)
    values.insert(bias, np.zeros(1))
    graph.add(time_offset_prior(bias, 0.0, 3.0))
    for k in range(frames):
        lPs = np.stack([rng.uniform(6, 40, 60), rng.uniform(-6, 6, 60), rng.uniform(-2, 1, 60)], axis=1)
        angle = rng.uniform(0.0, 2.0 * np.pi, 60)
        normals = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        blank = Alignment(CAMERA, lPs, -0.02, np.zeros((60, 2)), 1.5)
        twist = rng.normal(0.0, 1.0, 6) * [0.1, 0.3, 0.1, 0.5, 0.3, 6.0]
        pixels, _ = residuals(blank, TRUE, OFFSET_S, twist, jacobians=False)
        noisy = pixels.reshape(2, -1).T + rng.normal(0.0, 1.5, (60, 2))
        seen = replace(blank, pixels=noisy, normals=normals)
        key = gtsam.symbol("V", 1000 * seed + k)
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([0.01, 0.1], 3))
        graph.add(gtsam.PriorFactorVector(key, twist, noise))
        values.insert(key, twist)
        graph.add(frame_factor([seen], EXTRINSIC, TIME_OFFSET, key, bias))
    return graph, values


def solved(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> tuple[gtsam.Pose3, float]:
    """One Gauss-Newton step of the whole graph, the dense way."""
    ordering = gtsam.Ordering()
    for key in values.keys():  # noqa: SIM118
        ordering.push_back(key)
    H, g = graph.linearize(values).hessian(ordering)
    step = np.linalg.solve(H, g)
    at = {}
    for key in values.keys():  # noqa: SIM118
        dim = 6 if chr(gtsam.Symbol(key).chr()) in "EV" else 1
        at[key], step = step[:dim], step[dim:]
    cTl = values.atPose3(EXTRINSIC).retract(at[EXTRINSIC])
    return cTl, float(values.atVector(TIME_OFFSET)[0] + at[TIME_OFFSET][0])


def in_sigmas(found: CalibrationMarginal, cTl: gtsam.Pose3, time_offset_s: float) -> float:
    """Distance of the marginal's optimum from an estimate, in the marginal's own sigmas."""
    d = found.best().local_coordinates(Calibration(cTl, time_offset_s))
    return float(np.sqrt(d @ found.information @ d))


def test_the_marginal_of_a_result_is_its_robust_covariance() -> None:
    found = marginal(3)
    np.testing.assert_allclose(found.covariance(), covariance(3), rtol=1e-8, atol=1e-14)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(found.factor())
    marginals = gtsam.Marginals(graph, found.point())
    np.testing.assert_allclose(
        marginals.marginalCovariance(EXTRINSIC), covariance(3)[:6, :6], rtol=1e-6, atol=1e-12
    )
    assert marginals.marginalCovariance(TIME_OFFSET).item() == pytest.approx(covariance(3)[6, 6], rel=1e-6)


def test_the_error_is_the_documented_quadratic() -> None:
    found = replace(marginal(4), vector=np.arange(7.0), constant=5.0)
    d = np.random.default_rng(0).normal(size=7) * 0.01
    values = gtsam.Values()
    values.insert(EXTRINSIC, found.cTl * gtsam.Pose3.Expmap(d[:6]))
    values.insert(TIME_OFFSET, np.array([found.time_offset_s + d[6]]))
    expected = 0.5 * d @ found.information @ d - found.vector @ d + 0.5 * found.constant
    assert found.factor().error(values) == pytest.approx(expected, rel=1e-6)


READER = """
import json, pickle, sys
sys.modules["sst_graph"] = None  # an import of it fails
try:
    import sst_graph
except ImportError:
    pass
else:
    raise AssertionError("sst_graph can be imported")
import gtsam, numpy as np
document = json.load(open(sys.argv[1]))
E, D = (int(variable["key"]) for variable in document["variables"])
assert E == gtsam.symbol("E", 0) and D == gtsam.symbol("D", 0)
# rebuilt from the plain numbers
L, g = np.array(document["information"]), np.array(document["vector"])
hessian = gtsam.HessianFactor(E, D, L[:6, :6], L[:6, 6:], g[:6], L[6:, 6:], g[6:], document["constant"])
point = gtsam.Values()
point.insert(E, gtsam.Pose3(np.array(document["linearization_point"]["T_camera_lidar"])))
point.insert(D, np.array([document["linearization_point"]["time_offset_s"]]))
plain = gtsam.LinearContainerFactor(hessian, point)
# from the Boost archive, and from the pickle
archive = gtsam.LinearContainerFactor(gtsam.HessianFactor())
archive.deserialize(document["gtsam_serialized"])
pickled = pickle.load(open(sys.argv[2], "rb"))
elsewhere = gtsam.Values()
elsewhere.insert(E, point.atPose3(E).retract(np.full(6, 0.01)))
elsewhere.insert(D, point.atVector(D) + 0.01)
assert not [name for name in sys.modules if name.startswith("sst_graph.")]
print(json.dumps([factor.error(elsewhere) for factor in (plain, archive, pickled)]))
"""


def test_reads_back_in_a_fresh_process_without_us(tmp_path: Path) -> None:
    found = replace(marginal(5), vector=np.arange(7.0), constant=2.0)
    (tmp_path / "marginal.json").write_text(found.to_json())
    (tmp_path / "marginal.pickle").write_bytes(pickle.dumps(found.factor()))
    (tmp_path / "reader.py").write_text(READER)
    command = [sys.executable, "-I", "reader.py", "marginal.json", "marginal.pickle"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    values = gtsam.Values()
    values.insert(EXTRINSIC, found.cTl.retract(np.full(6, 0.01)))
    values.insert(TIME_OFFSET, np.array([found.time_offset_s + 0.01]))
    assert json.loads(done.stdout) == pytest.approx([found.factor().error(values)] * 3, rel=1e-9)


def test_json_reads_back() -> None:
    found = replace(marginal(6), vector=np.arange(7.0), constant=2.0)
    again = CalibrationMarginal.from_json(found.to_json())
    np.testing.assert_array_equal(again.information, found.information)
    np.testing.assert_array_equal(again.vector, found.vector)
    assert again.cTl.equals(found.cTl, 1e-12) and again.time_offset_s == found.time_offset_s
    assert again.constant == found.constant


@pytest.mark.parametrize("text", ["", "{}", '{"format": "sst-graph/marginal", "version": 2}', "[1]"])
def test_refuses_other_files(text: str) -> None:
    with pytest.raises(DataError, match=r"marginal\.json"):
        CalibrationMarginal.from_json(text)


def _changed(path: tuple[str, ...], value: object) -> str:
    document = json.loads(marginal(6).to_json())
    holder = document
    for key in path[:-1]:
        holder = holder[key]
    holder[path[-1]] = value
    return json.dumps(document)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("information",), np.full((7, 7), 1e308).tolist(), "entries of at most"),
        (("information",), (-np.eye(7)).tolist(), "on the diagonal"),
        (("information",), np.triu(np.ones((7, 7))).tolist(), "not symmetric"),
        (("information",), (np.ones((7, 7)) - 0.5 * np.eye(7)).tolist(), "positive semi-definite"),
        (("information",), [[None] * 7] * 7, "no numeric array"),
        (("vector",), [1.0] * 6, r"shape \(6,\)"),
        (("constant",), "0", "constant: found '0', expected a number"),
        (("linearization_point",), [], "an object"),
        (("linearization_point", "time_offset_s"), 1e300, "time offset of at most"),
        (("linearization_point", "T_camera_lidar"), (2 * np.eye(4)).tolist(), "last row"),
    ],
)
def test_refuses_numbers_that_are_no_marginal(
    tmp_path: Path, path: tuple[str, ...], value: object, message: str
) -> None:
    file = tmp_path / "marginal.json"
    file.write_text(_changed(path, value))
    with pytest.raises(DataError, match=rf"marginal\.json.*{message}"):
        read_marginal(file)


def test_reads_a_file(tmp_path: Path) -> None:
    (tmp_path / "marginal.json").write_text(marginal(6).to_json())
    found = read_marginal(tmp_path / "marginal.json")
    np.testing.assert_array_equal(found.information, marginal(6).information)
    with pytest.raises(DataError, match="no such file"):
        read_marginal(tmp_path / "nothing.json")


def test_fusing_two_drives_equals_the_joint_batch() -> None:
    drives = [drive(1), drive(2)]
    fused = fuse_marginals([marginal_of_graph(g, v, EXTRINSIC, TIME_OFFSET) for g, v in drives])
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for one, start in drives:
        graph.push_back(one)
        values.insert_or_assign(start)
    cTl, time_offset_s = solved(graph, values)
    assert in_sigmas(fused, cTl, time_offset_s) < 1e-3
    joint = marginal_of_graph(graph, values, EXTRINSIC, TIME_OFFSET)
    # the fused one is written about its own optimum
    J = np.eye(7)
    J[:6, :6] = gtsam.Pose3.LogmapDerivative(joint.cTl.localCoordinates(fused.cTl))
    expected = J.T @ joint.information @ J
    np.testing.assert_allclose(fused.information, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("seeds", [(3, 4), (5, 6), (7, 8)])
def test_fusing_drives_through_marginals_equals_one_graph_of_both(seeds: tuple[int, int]) -> None:
    # Each drive linearized at its own optimum: thousandths to hundredths of a sigma from the joint LM, for
    # the frozen graphs are not quadratic. Marginals taken again at the fused point close the gap.
    drives = []
    for seed in seeds:
        graph, start = drive(seed, 20)
        drives.append((graph, _optimum(graph, start)))
    joint = _batch(drives)
    first = [marginal_of_graph(graph, at) for graph, at in drives]
    assert in_sigmas(fuse_marginals(first), *joint) < 0.03 < in_sigmas(first[0], *joint)
    fused, parts = fuse_graphs(drives)
    assert in_sigmas(fused, *joint) < 1e-3
    # the parts stand about the fused point, and there they add up to it
    for part in parts:
        assert np.linalg.norm(part.cTl.localCoordinates(fused.cTl)) < 1e-6
    total = np.sum([part.information for part in parts], axis=0)
    np.testing.assert_allclose(fused.information, total, rtol=1e-4, atol=1e-6 * np.abs(total).max())


def test_a_stored_marginal_follows_the_second_drive() -> None:
    # one after the other: the first drive's marginal goes as a factor into the second one's graph, is then
    # made again where that ends, and goes in again
    (one, at_one), (two, start) = drive(3, 20), drive(4, 20)
    at_one = _optimum(one, at_one)
    joint = _batch([(one, at_one), (two, start)])
    distances, point = [], None
    for _ in range(4):
        stored = CalibrationMarginal.from_json(marginal_of_graph(one, at_one, at=point).to_json())
        graph = gtsam.NonlinearFactorGraph(two)
        graph.add(stored.factor())
        found = _optimum(graph, start)
        point = found.atPose3(EXTRINSIC), float(found.atVector(TIME_OFFSET)[0])
        both = marginal_of_graph(graph, found)
        distances.append(in_sigmas(both, *joint))
    assert 1e-3 < distances[0] < 0.03 and distances[-1] < 1e-3


@pytest.mark.slow
def test_real_matches_of_two_simulated_drives() -> None:
    graphs = [_matched(number) for number in range(2)]
    joint = _batch(graphs)
    fused, _ = fuse_graphs(graphs)
    assert in_sigmas(fused, *joint) < 1e-3
    alone = [marginal_of_graph(graph, values) for graph, values in graphs]
    assert min(in_sigmas(part, *joint) for part in alone) > 0.1


def _matched(number: int) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The joint method's frozen graph of a small drive through a street, solved."""
    street = SimulationConfig(
        seed=4,
        frames=3,
        width=621,
        height=188,
        azimuth_limit_deg=45.0,
        azimuth_step_deg=0.4,
        vehicle_density=0.25,
        moving_fraction=0.0,
        motion=("constant", "no_stop")[number],
        speed_mps=(8.0, 3.0)[number],
    )
    source = simulated(street)
    prepared = prepare_drive(source, [SemanticClass.VEHICLE], PrepareConfig(use_visual_odometry=False))
    state = State(source.truth.cTl.retract(np.full(6, 2e-3)), (street.time_offset_s,))
    config = GraphConfig(object_bias_sigma_px=0.0)
    pairs = associate([prepared], motions_of([prepared]), state, RobustKernel("geman_mcclure", 5.0), config)
    # the second drive's own variables get the numbers of a drive 1
    pairs = [replace(pair, drive=number) for pair in pairs]
    graph, values = joint_graph(pairs, state, config)
    return graph, _optimum(graph, values)


def _batch(
    drives: list[tuple[gtsam.NonlinearFactorGraph, gtsam.Values]],
) -> tuple[gtsam.Pose3, float]:
    """Optimum of one graph over all drives."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for one, start in drives:
        graph.push_back(one)
        values.insert_or_assign(start)
    batch = _optimum(graph, values)
    return batch.atPose3(EXTRINSIC), float(batch.atVector(TIME_OFFSET)[0])


def test_another_point_moves_the_expansion_and_not_the_cost() -> None:
    graph, start = drive(9, 8)
    best = _optimum(graph, start)
    there = best.atPose3(EXTRINSIC).retract(np.full(6, 1e-4)), float(best.atVector(TIME_OFFSET)[0]) + 1e-4
    about = marginal_of_graph(graph, best, at=there)
    assert about.cTl.equals(there[0], 1e-9) and about.time_offset_s == pytest.approx(there[1], abs=1e-12)
    assert in_sigmas(about, best.atPose3(EXTRINSIC), float(best.atVector(TIME_OFFSET)[0])) < 2e-3
    alone = fuse_graphs([(graph, start)])[0]
    assert in_sigmas(alone, best.atPose3(EXTRINSIC), float(best.atVector(TIME_OFFSET)[0])) < 1e-3


def _optimum(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> gtsam.Values:
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-13)
    params.setAbsoluteErrorTol(0.0)
    return gtsam.LevenbergMarquardtOptimizer(graph, start, params).optimize()


def test_fusion_is_that_of_gtsam_on_the_factors() -> None:
    parts = [marginal(7), marginal(8), marginal(9)]
    graph = gtsam.NonlinearFactorGraph()
    for part in parts:
        graph.add(part.factor())
    found = gtsam.LevenbergMarquardtOptimizer(graph, parts[0].point()).optimize()
    fused = fuse_marginals(parts)
    assert in_sigmas(fused, found.atPose3(EXTRINSIC), float(found.atVector(TIME_OFFSET)[0])) < 0.02
    alone = min(np.sqrt(np.diag(part.covariance())).tolist() for part in parts)
    assert (np.sqrt(np.diag(fused.covariance())) < alone).all()


def test_refuses_what_is_not_determined() -> None:
    with pytest.raises(EstimationError, match="no marginal"):
        fuse_marginals([])
    flat = replace(marginal(1), information=np.zeros((7, 7)))
    with pytest.raises(EstimationError, match="information"):
        flat.best()
    graph, values = drive(1, 2)
    graph.add(gtsam.PriorFactorVector(TIME_OFFSET, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, 1.0)))
    values.insert(99, np.zeros(1))
    graph.add(gtsam.PriorFactorVector(99, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, 1e300)))
    with pytest.raises(EstimationError, match="to eliminate"):
        marginal_of_graph(graph, values, EXTRINSIC, TIME_OFFSET)


def knocked(found: CalibrationMarginal, column: int, size: float) -> CalibrationMarginal:
    """The same about another optimum."""
    d = np.zeros(7)
    d[column] = size
    return replace(found, cTl=found.cTl.retract(d[:6]), time_offset_s=found.time_offset_s + float(d[6]))


def agreeing(seed: int) -> CalibrationMarginal:
    """A calibration that errs as its covariance says, its sigmas those of a good one."""
    sigmas = np.array([0.0005] * 3 + [0.005] * 3 + [0.001])
    d = sigmas * np.random.default_rng(seed).normal(size=7)
    result = CalibrationResult(TRUE.retract(d[:6]), OFFSET_S + d[6], np.diag(sigmas**2), "ok", CAMERA)
    return marginal_of_result(result)


def test_marginals_that_agree_are_fused_and_their_constant_is_chi_squared() -> None:
    constants = [fuse_marginals([agreeing(2 * seed), agreeing(2 * seed + 1)]).constant for seed in range(200)]
    assert np.mean(constants) == pytest.approx(7.0, rel=0.1)
    assert np.var(constants) == pytest.approx(14.0, rel=0.4)


@pytest.mark.parametrize(
    ("column", "size", "words"),
    [
        (1, -np.radians(1.1), r"rotation by 1\.\d+° .*\(pitch\)"),
        (6, 0.1, r"time offset by \+(9[789]|10[0-3]) ms"),
    ],
)
def test_marginals_that_contradict_one_another_are_refused(column: int, size: float, words: str) -> None:
    parts = [agreeing(1), agreeing(2), knocked(agreeing(3), column, size)]
    with pytest.raises(ContradictionError, match=f"of 14.*'c' differs from the others in {words}"):
        fuse_marginals(parts, names=("a", "b", "c"))
    with pytest.raises(EstimationError, match="number 2"):
        fuse_marginals(parts)
    fused = fuse_marginals(parts, significance=0.0)
    assert fused.constant > 1000.0


def test_one_of_many_marginals_is_found() -> None:
    """Six sigmas of one in twenty: the sum's chi-squared of 133 would hardly show it."""
    parts = [agreeing(seed) for seed in range(20)]
    fuse_marginals(parts)
    with pytest.raises(ContradictionError, match="number 7"):
        fuse_marginals([*parts[:7], knocked(agreeing(7), 0, 8.0 * 0.0005), *parts[8:]])


def test_a_direction_that_one_marginal_does_not_tell_contradicts_nothing() -> None:
    vague = agreeing(4)
    information = vague.information.copy()
    information[6] = information[:, 6] = 0.0
    vague = replace(vague, information=information, time_offset_s=vague.time_offset_s + 0.3)
    fused = fuse_marginals([agreeing(5), vague])
    assert fused.time_offset_s == pytest.approx(OFFSET_S, abs=0.005)


SCANS = tuple(f"{k:016x}" for k in range(32))


def test_marginals_of_the_same_scans_are_refused() -> None:
    """Counted twice they make the fused result too sure; a single scan in common is enough."""
    one, other = (replace(agreeing(k), common=Common({}, SCANS[8 * k : 8 * k + 8])) for k in (1, 2))
    again = replace(agreeing(3), common=Common({}, (SCANS[15], SCANS[31])))
    fused = fuse_marginals([one, other])
    assert fused.common.scan_hashes == SCANS[8:24] == one.plus(other).common.scan_hashes
    for parts, names in (([one, other, again], ("a", "b", "c")), ([fused, again], ("b", "c"))):
        with pytest.raises(EstimationError, match=r"'[ab]' and 'c' are of the same scans: counted twice"):
            fuse_marginals(parts, names=names)
    assert set(fuse_marginals([fused, again], significance=0.0).common.scan_hashes) > {SCANS[31]}


def test_equal_marginals_are_refused_without_knowing_their_scans() -> None:
    """As those of older files, and of graphs."""
    with pytest.raises(EstimationError, match="number 0 and number 1 are of the same scans"):
        fuse_marginals([agreeing(1), agreeing(1)])
    graph, start = drive(3)
    with pytest.raises(EstimationError, match="number 0 and number 1 are of the same scans"):
        fuse_graphs([(graph, start), (graph, start)])


def test_scans_in_a_file() -> None:
    known = replace(agreeing(1), common=Common({}, SCANS))
    assert CalibrationMarginal.from_json(known.to_json()) == known
    assert "scan_hashes" not in agreeing(1).to_json()
    found = marginal_of_result(
        CalibrationResult(TRUE, OFFSET_S, covariance(1), "ok", CAMERA, diagnostics={"scan_hashes": SCANS[:2]})
    )
    assert found.common.scan_hashes == SCANS[:2]
    for wrong in ("abc", "A" * 16, 5, "0" * 17):
        with pytest.raises(FactorError, match="scan_hashes of what marginals"):
            Common({}, (wrong,))  # type: ignore[arg-type]
        with pytest.raises(DataError, match="scan_hashes"):
            CalibrationMarginal.from_json(json.dumps({**json.loads(known.to_json()), "scan_hashes": [wrong]}))


def test_fusion_ends_at_the_optimum_also_from_far_apart() -> None:
    one, other = agreeing(1), knocked(agreeing(2), 0, np.radians(3.0))
    fused = fuse_marginals([one, other], significance=0.0)
    again = fuse_marginals([other, one], significance=0.0)
    assert in_sigmas(fused, again.cTl, again.time_offset_s) < 1e-4


def test_graphs_of_drives_with_two_mounts_are_refused() -> None:
    (one, at_one), (two, start) = drive(3, 20), drive(4, 20)
    moved = gtsam.NonlinearFactorGraph(two)
    there = TRUE.retract(np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.0]))
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([1e-4, 1e-2], 3))
    moved.add(gtsam.PriorFactorPose3(EXTRINSIC, there, noise))
    graphs = [(one, _optimum(one, at_one)), (moved, _optimum(moved, start))]
    with pytest.raises(ContradictionError, match="2 marginals contradict one another"):
        fuse_graphs(graphs)
    fused, _ = fuse_graphs(graphs, significance=0.0)
    assert in_sigmas(fused, *_batch(graphs)) < 1e-3
    with pytest.raises(EstimationError, match="found 1 name, expected 2"):
        fuse_marginals([agreeing(1), agreeing(2)], names=("a",))


def _priors(on: str, double: bool = False) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Priors on some of extrinsic, time offset, and a pose that is tied to the extrinsic."""
    graph, values, unit = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.noiseModel.Unit
    values.insert(EXTRINSIC, TRUE)
    offset = OFFSET_S if double else np.array([OFFSET_S])
    values.insert(TIME_OFFSET, offset)
    if "E" in on:
        graph.add(gtsam.PriorFactorPose3(EXTRINSIC, TRUE, unit.Create(6)))
    if "D" in on:
        prior = gtsam.PriorFactorDouble if double else gtsam.PriorFactorVector
        graph.add(prior(TIME_OFFSET, offset, unit.Create(1)))
    if "x" in on:
        values.insert(7, TRUE)
        graph.add(gtsam.BetweenFactorPose3(EXTRINSIC, 7, gtsam.Pose3(), unit.Create(6)))
        graph.add(gtsam.PriorFactorPose3(7, TRUE, unit.Create(6)))
    return graph, values


@pytest.mark.parametrize(
    ("on", "expected"),
    [("E", [1.0] * 6 + [0.0]), ("D", [0.0] * 6 + [1.0]), ("x", [0.5] * 6 + [0.0]), ("", [0.0] * 7)],
)
def test_what_no_factor_is_on_has_no_information(on: str, expected: list[float]) -> None:
    """With a pose in the graph and no factor on the offset, too: nothing of the pose counts for it."""
    marginal = marginal_of_graph(*_priors(on))
    np.testing.assert_allclose(marginal.information, np.diag(expected), atol=1e-12)
    whole, _ = fuse_graphs([_priors(on), _priors("ED")])
    np.testing.assert_allclose(whole.information, np.diag(np.add(expected, 1.0)), atol=1e-12)


def test_a_time_offset_that_is_a_double() -> None:
    """As ``time_offset_prior(..., double=True)`` keeps it."""
    for on in ("ED", "EDx"):
        one, other = marginal_of_graph(*_priors(on)), marginal_of_graph(*_priors(on, double=True))
        assert one.to_json() == other.to_json()
        at = Calibration(TRUE, OFFSET_S + 0.1)
        moved = marginal_of_graph(*_priors(on, double=True), at=at)
        assert moved.to_json() == marginal_of_graph(*_priors(on), at=at).to_json()


def test_graphs_that_cannot_be_used() -> None:
    graph, values = _priors("EDx")
    with pytest.raises(FactorError, match="values: found none of the key 7, expected one of each variable"):
        marginal_of_graph(graph, _priors("ED")[1])
    for key, value, message in (
        (EXTRINSIC, gtsam.Pose2(), "a variable E0 of another kind, expected a Pose3"),
        (TIME_OFFSET, np.zeros(2), "a variable D0 of another kind, expected a vector of one number"),
    ):
        other = gtsam.Values(values)
        other.erase(key)
        other.insert(key, value)
        with pytest.raises(FactorError, match=message):
            marginal_of_graph(gtsam.NonlinearFactorGraph(), other)
    graph.add(gtsam.PriorFactorPose3(EXTRINSIC, TRUE, gtsam.noiseModel.Constrained.All(6)))
    with pytest.raises(EstimationError, match=r"graph: cannot be linearized and eliminated \(.*constrained"):
        marginal_of_graph(graph, values)


@pytest.mark.parametrize("wrong", [None, "0.01", True, -0.1, 1.1, float("nan"), [0.01]])
def test_a_significance_is_a_probability(wrong: object) -> None:
    """NaN is none: nothing would be tested by it."""
    with pytest.raises(FactorError, match=r"significance: found .*, expected a probability from 0 to 1"):
        fuse_marginals([marginal_of_graph(*_priors("ED"))], significance=wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("wrong", [None, 5, "a", ["a", 3]])
def test_names_are_texts(wrong: object) -> None:
    with pytest.raises(FactorError, match=r"names: found .*, expected a (list of )?text"):
        fuse_marginals([marginal_of_graph(*_priors("ED"))], names=wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_marginal_is_refused(name: str) -> None:
    """By a sentence of ours, whatever stands in the place of an argument."""
    wrong = WRONG[name]
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(EXTRINSIC, gtsam.Pose3())
    values.insert(TIME_OFFSET, np.zeros(1))
    calls = {
        "result": lambda: marginal_of_result(wrong),
        "marginals": lambda: fuse_marginals([wrong]),
        "a list": lambda: fuse_marginals(wrong),
        "graphs": lambda: fuse_graphs([wrong]),
        "pairs": lambda: fuse_graphs(wrong),
        "graph": lambda: marginal_of_graph(graph if name == "graph" else wrong, gtsam.Values()),
        "values": lambda: marginal_of_graph(graph, wrong),
        "key": lambda: marginal_of_graph(graph, values, wrong),
        "at": lambda: marginal_of_graph(graph, values, at=wrong) if wrong is not None else fuse_marginals([]),
    }
    for call in calls.values():
        with pytest.raises((FactorError, SstGraphError)):
            call()


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"cTl": None}, "cTl of CalibrationMarginal: found None"),
        (
            {"cTl": gtsam.Pose3(gtsam.Rot3(np.diag([1.0, 1.0, -1.0])), np.zeros(3))},
            "expected a rotation matrix",
        ),
        ({"time_offset_s": "x"}, "time_offset_s of CalibrationMarginal: found the text 'x'"),
        ({"information": np.eye(6)}, r"found shape \(6, 6\)"),
        ({"information": np.eye(7) + np.diag([0.5], 6)}, "a matrix that is not symmetric"),
        ({"information": np.ma.masked_equal(np.eye(7), 1.0)}, "7 masked values"),
        ({"vector": np.full(7, np.nan)}, "7 values NaN or inf"),
    ],
)
def test_a_marginal_of_other_parts_is_refused(change: dict[str, object], found: str) -> None:
    given = {"cTl": gtsam.Pose3(), "time_offset_s": 0.0, "information": np.eye(7), "vector": np.zeros(7)}
    assert CalibrationMarginal(**given).covariance().shape == (7, 7)  # type: ignore[arg-type]
    with pytest.raises(SstGraphError, match=found):
        CalibrationMarginal(**{**given, **change})  # type: ignore[arg-type]


@pytest.mark.parametrize("dtype", ["f2", ">f8", "g", "O"])
def test_numbers_of_any_type_make_the_same_marginal(dtype: str) -> None:
    whole = CalibrationMarginal(gtsam.Pose3(), 0.5, 4.0 * np.eye(7), np.zeros(7))
    information = (4.0 * np.eye(7)).astype(dtype)
    if dtype == "O":
        with pytest.raises(FactorError, match="expected numbers"):
            CalibrationMarginal(gtsam.Pose3(), 0.5, information, np.zeros(7))
    else:
        given = CalibrationMarginal(gtsam.Pose3(), np.array(0.5), information, np.zeros(7))  # type: ignore[arg-type]
        assert given == whole and given.to_json() == whole.to_json()
