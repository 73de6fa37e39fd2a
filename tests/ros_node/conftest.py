"""The bag that a node is tried on."""

from __future__ import annotations

from pathlib import Path

import pytest
from stored import written
from streets import SHORT_STREET

from sst_graph.data import KittiSource, open_source


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The short street with its masks: images are received 25 ms after the clouds of the same stamp."""
    from bags import bag_of  # needs rosbags

    source = open_source(written(SHORT_STREET))
    assert isinstance(source, KittiSource)
    return bag_of(source, tmp_path_factory.mktemp("bag") / "mcap")
