"""``sst-graph settings``: every setting of ``calibrate`` and ``track``, and what it is for."""

from __future__ import annotations

import argparse
import dataclasses
import json
from typing import Any

from sst_graph.batch import CalibrationConfig
from sst_graph.cli.messages import say
from sst_graph.config.listing import SettingEntry, as_markdown, as_text, list_settings
from sst_graph.errors import ConfigError
from sst_graph.tracker.config import TrackerConfig

SHARED = "calibration."
"""What the tracker's names of ``calibrate``'s settings begin with."""

_INTRODUCTION = """# Settings

Made by `sst-graph settings --markdown > docs/reference/settings.md`.

`calibrate` has {calibrate} settings. `track` takes them as `calibration.NAME`, and has {track} of its own.
Give them with `--set NAME=VALUE`, or with `--config FILE` in JSON or TOML. An unknown name is refused with
the nearest known one, a value out of its range with the bounds. All else is a constant beside its use.
"""


def run(args: argparse.Namespace) -> int:
    """Print the settings whose names contain ``args.name``."""
    of_calibrate = list_settings(CalibrationConfig(), args.name)
    of_track = [entry for entry in list_settings(TrackerConfig(), args.name) if not _is_shared(entry)]
    if not (of_calibrate or of_track):
        raise ConfigError(f"settings {args.name!r}: no name contains it (sst-graph settings lists all)")
    if args.json:
        say(_json(of_calibrate, of_track))
    elif args.markdown:
        say(settings_page(of_calibrate, of_track), end="")
    else:
        for command, entries in (("calibrate", of_calibrate), ("track", of_track)):
            plural = "s" * (len(entries) != 1)
            text = f"\n\n{as_text(entries)}" if entries else "\n"
            say(f"{command}: {len(entries)} setting{plural}{text}")
    return 0


def settings_page(of_calibrate: list[SettingEntry], of_track: list[SettingEntry]) -> str:
    """The settings as a page of Markdown."""
    introduction = _INTRODUCTION.format(calibrate=len(of_calibrate), track=len(of_track))
    return f"{introduction}\n## calibrate\n\n{as_markdown(of_calibrate)}\n## track\n\n{as_markdown(of_track)}"


def _json(of_calibrate: list[SettingEntry], of_track: list[SettingEntry]) -> str:
    """The settings of each command as JSON, defaults as values."""
    lists = {"calibrate": list(map(_plain, of_calibrate)), "track": list(map(_plain, of_track))}
    return json.dumps(lists, indent=1, ensure_ascii=False)


def _plain(entry: SettingEntry) -> dict[str, Any]:
    return {**dataclasses.asdict(entry), "default": json.loads(entry.default)}


def _is_shared(entry: SettingEntry) -> bool:
    return entry.name.startswith(SHARED)
