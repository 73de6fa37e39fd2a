"""Recordings read back with rerun's own reader."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader

FRAME = "frame"


class RrdFile:
    """What was logged: values by entity, component and frame."""

    def __init__(self, path: Path) -> None:
        self.values: dict[tuple[str, str], dict[int | None, Any]] = {}
        for chunk in RrdReader(path).stream():
            entity, batch = chunk.entity_path, chunk.to_record_batch()
            table = batch.to_pydict()
            frames = table.get(FRAME, [None] * batch.num_rows)
            for name, column in table.items():
                for frame, value in zip(frames, column, strict=True):
                    if value is not None:
                        self.values.setdefault((entity, name.rpartition(":")[2]), {})[frame] = value

    @property
    def entities(self) -> set[str]:
        return {entity for entity, _ in self.values}

    def of(self, entity: str, component: str) -> dict[int | None, Any]:
        """Values by frame; None for what is static."""
        return self.values[entity, component]

    def components(self, entity: str) -> Iterator[str]:
        return (component for one, component in self.values if one == entity)
