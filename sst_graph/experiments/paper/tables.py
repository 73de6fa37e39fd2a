"""The four tables: their questions, settings and printed figures, and what is written of each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from sst_graph.drive.preparation import Progress
from sst_graph.experiments.paper.config import PaperTableConfig
from sst_graph.experiments.paper.drives import table_drives
from sst_graph.experiments.paper.plot import check_plot, plot_svg
from sst_graph.experiments.paper.runs import Case, CaseRun, cases_of, runs_of
from sst_graph.experiments.paper.summary import Layout, Printed, csv_text, markdown
from sst_graph.experiments.tasks.resumable import Work, rows_of

STATE = "paper-tables.runs.jsonl"
"""File of runs in the folder of --out; the four tables share it, for some of their runs are the same."""

_STATIC = Printed("SST-Calib, static stage", 8.8, (1.28, 0.81), (18.9, 12.8))
_JOINT = Printed("SST-Calib, joint stage", None, (0.67, 0.66), (7.45, 5.52), 3.4)
_SEMALIGN = Printed("SemAlign", None, (1.14, 0.46))
"""The paper's own figures, from starts of 10 degrees on KITTI sequence 00 with labels from networks."""


@dataclass(frozen=True)
class PaperTable:
    """A table.

    Attributes:
        summary: what it shows, in a line.
        layout: its heading, columns and printed figures.
        config: its default settings.
    """

    summary: str
    layout: Layout
    config: PaperTableConfig

    def run(self, config: PaperTableConfig, progress: Progress | None = None) -> str:
        """The table as Markdown; nothing is kept."""
        return markdown(self._runs(config, progress, None), self.layout, config)

    def files(self, config: PaperTableConfig, progress: Progress | None, out: Path) -> Mapping[Path, str]:
        """Contents of all its files, by path; runs are kept beside them, and done ones are not run again.

        Raises:
            ConfigError, DataError: a setting, a drive or the file of runs cannot be used.
            MissingDependencyError: matplotlib is not installed, and a plot is wanted.
            SstGraphError: a process ended before its time.
        """
        if config.plot:
            check_plot()
        runs = self._runs(config, progress, out.parent / STATE)
        texts = [markdown(runs, self.layout, config), csv_text(runs, config)]
        if config.plot:
            texts.append(plot_svg(runs, self.layout, config))
        return dict(zip(self.paths(config, out), texts, strict=True))

    def paths(self, config: PaperTableConfig, out: Path) -> tuple[Path, ...]:
        """Table, values of each run, and the plot where there is one."""
        plots = (out.with_suffix(".svg"),) if config.plot else ()
        return out, out.with_suffix(".csv"), *plots

    def _runs(self, config: PaperTableConfig, progress: Progress | None, state: Path | None) -> list[CaseRun]:
        """All runs of the table in its order."""
        run, key = partial(runs_of, config=config), partial(Case.key, config=config)
        work = Work(run, CaseRun, config.jobs, "" if state is None else str(state), key)
        return rows_of(work, cases_of(table_drives(config), config), progress)


TABLES: Mapping[str, PaperTable] = {
    "table1": PaperTable(
        "SST-Calib's static stage: bi- against single-directional loss",
        Layout("Static stage: bi-directional against single-directional loss", (_STATIC,), False),
        PaperTableConfig(
            methods=("static", "static-single", "joint"),
            images_late=(0,),
            standing=True,
            frames=6,
            kitti_frames=(547, 553),
        ),
    ),
    "table2": PaperTable(
        "its static stage beside SemAlign, motion and joint",
        Layout("Static stage beside other methods", (_STATIC, _SEMALIGN), False),
        PaperTableConfig(methods=("static", "semalign", "motion", "joint")),
    ),
    "table3": PaperTable(
        "its joint stage beside the joint method, images a frame late",
        Layout("Joint stage: pose and time offset", (_JOINT,), True),
        PaperTableConfig(methods=("paper", "joint")),
    ),
    "table4": PaperTable(
        "time offsets of 0, 1 and 2 frames by both",
        Layout("Time offset by the frames that the images are late", (_JOINT,), True),
        PaperTableConfig(methods=("paper", "joint"), images_late=(0, 1, 2)),
    ),
}
