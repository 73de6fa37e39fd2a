"""The guard of the hot paths: what grows by a quarter is named, what was not checked is not passed over."""

from __future__ import annotations

import json

import pytest

from benchmarks import guard


def test_a_quarter_more_is_found_and_a_tenth_is_not() -> None:
    expected = json.loads(guard.EXPECTED.read_text())["instructions"]
    assert len(expected) >= 7
    for name in expected:
        dearer = {one: round(count * (1.25 if one == name else 1.1)) for one, count in expected.items()}
        assert guard.grown(dearer, expected) == [name]


def test_a_path_without_an_expected_count_is_refused() -> None:
    with pytest.raises(SystemExit, match="--renew"):
        guard.grown({"new": 1}, {"old": 1})


@pytest.mark.parametrize("required", [False, True])
def test_nothing_checked_is_said(
    required: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", "/nowhere")  # no valgrind
    monkeypatch.setattr("sys.argv", ["guard", *(["--required"] if required else [])])
    if required:
        with pytest.raises(SystemExit) as ended:
            guard.main()
        assert ended.value.code == 1
    else:
        guard.main()
    assert "NOTHING WAS CHECKED" in capsys.readouterr().err
