"""Which reason against an estimate by edges is said first."""

from __future__ import annotations

from sst_graph.batch.by_edges.reasons import EdgeContrast, contrast_reasons, with_lens_reasons

LENS = ("the pictures look distorted: k1 = -0.1 ± 0.017",)


def test_a_lens_is_blamed_first_where_the_pose_is_right() -> None:
    right = EdgeContrast(score=500.0, sigmas=12.0, ratio=2.0, other=300.0)
    assert with_lens_reasons(("farther edges",), LENS, right) == (*LENS, "farther edges")


def test_a_pose_that_may_be_wrong_altogether_is_said_before_its_lens() -> None:
    for doubtful in (
        EdgeContrast(score=500.0, sigmas=4.7, ratio=1.1, other=0.0),
        EdgeContrast(score=502.0, sigmas=12.0, ratio=2.0, other=476.0),
    ):
        reasons = tuple(contrast_reasons(doubtful))
        assert len(reasons) == 1 and with_lens_reasons(reasons, LENS, doubtful) == (*reasons, *LENS)
