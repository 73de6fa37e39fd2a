"""``python -m sst_graph.cli.one_drive``: ``sst-graph`` for a batch, which asks whether the data are at fault.

The exit codes are those of ``sst-graph``, but for two that are 2 there: 74 for an output that could not be
written, 70 for what nobody foresaw and for memory that ran out.
"""

from __future__ import annotations

from sst_graph.cli.process import own_process


def main() -> int:
    """Run the command that the process's arguments name; its exit code."""
    with own_process() as arguments:
        from sst_graph.cli.command import run

        return run(arguments, own_process=True, tells_apart=True)


if __name__ == "__main__":
    raise SystemExit(main())
