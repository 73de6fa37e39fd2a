"""Every command under every fault: kills, signals, a full disk, broken streams, a second writer.

    python -m checks.fault_matrix --moments 50 --out faults.md
    python -m checks.fault_matrix --moments 5 --rows kill,resume --commands simulate,track

Prints one Markdown table; exit code 1 if a row has a failure. A run fails if an output is neither what it was
nor what a run to its end makes of it (byte for byte, beside times; of a command that goes on from what is
done, each file), if something is left behind that the next run does not
remove, if there is a traceback, or if the exit code is another than docs/reference/faults.md says. Moments
are uniform over the time that the command takes.

A signal that comes before the interpreter has run the program's first line is the interpreter's: it ends the
process as Python does (``early`` counts them; they fail only if something is left behind).
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from checks.fault_commands import (
    COMMANDS,
    QUICK,
    ROOT,
    Command,
    State,
    calibrate_arguments,
    each_in,
    is_part,
    state,
    write_inputs,
)
from sst_graph.errors import SstGraphError
from sst_graph.experiments import markdown
from sst_graph.experiments.markdown import NONE
from sst_graph.files.staging import SUFFIX
from sst_graph.tracker import Tracker

PROGRAM = [sys.executable, "-c", "import sys; from sst_graph.cli import main; sys.exit(main())"]
"""What the installed script does."""

ENDED = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 129}
READER_GONE = 141
TIMEOUT_S = 300.0


@dataclass
class Row:
    """What a command did under a fault."""

    command: str
    fault: str
    runs: int = 0
    early: int = 0
    finished: int = 0
    failures: list[str] = field(default_factory=list)

    def check(self, holds: bool, what: str) -> None:
        """Count a failure unless it holds."""
        if not holds:
            self.failures.append(what)


@dataclass(frozen=True)
class Ended:
    """How a run ended."""

    code: int
    out: str
    err: str
    seconds: float


def without_stages(found: State) -> State:
    """A state without what is not finished."""
    return {name: data for name, data in found.items() if not name.endswith(SUFFIX)}


class Bench:
    """The inputs of all commands, made once, and what each command makes of them."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.data = folder, folder / "data"
        self._whole: dict[tuple[str, ...], tuple[State, float]] = {}
        self._made: dict[tuple[str, ...], Path] = {}
        self._number = 0
        if not self.data.exists():
            write_inputs(self.data)
            self.run([*calibrate_arguments(self.data, self.data)[:-1], str(self.data / "result"), *QUICK])

    def desk(self) -> Path:
        """An empty folder to write into."""
        self._number += 1
        desk = self.folder / f"desk{self._number}"
        shutil.rmtree(desk, ignore_errors=True)
        desk.mkdir()
        return desk

    def arguments(self, command: Command, desk: Path, *more: str) -> list[str]:
        return [*command.arguments(self.data, desk), *more]

    def whole(self, command: Command, *more: str) -> tuple[State, float]:
        """What stands in the desk after a run to its end, and how long the second such run took [s]."""
        key = (command.name, *more)
        if key not in self._whole:
            for _ in range(2):
                desk = self.desk()
                ended = self.run(self.arguments(command, desk, *more))
                if ended.code not in command.codes:
                    raise RuntimeError(f"{command.name}: {ended}")
            self._whole[key], self._made[key] = (without_checkpoint(state(desk)), ended.seconds), desk
        return self._whole[key]

    def lay_out(self, desk: Path, command: Command, *more: str) -> None:
        """Put what a run to its end has made into a desk, in the place of what is there."""
        self.whole(command, *more)
        shutil.rmtree(desk)
        shutil.copytree(self._made[command.name, *more], desk)

    def start(
        self, arguments: Sequence[str], limit: int | None = None, **streams: int | None
    ) -> subprocess.Popen[str]:
        """Start a command; ``limit``: bytes that any file may grow to."""

        def prepare() -> None:
            for number in ENDED:
                signal.signal(number, signal.SIG_DFL)
            if limit is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

        pipes: dict[str, int | None] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **streams}
        return subprocess.Popen(
            [*PROGRAM, *arguments],
            text=True,
            preexec_fn=prepare,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            cwd=self.folder,
            **pipes,  # type: ignore[call-overload]
        )

    def run(
        self,
        arguments: Sequence[str],
        send: tuple[int, float] | None = None,
        limit: int | None = None,
        **streams: int | None,
    ) -> Ended:
        """Run a command; ``send``: a signal and when [s]."""
        begin = time.monotonic()
        process = self.start(arguments, limit, **streams)
        if send is not None:
            number, moment = send
            time.sleep(max(0.0, begin + moment - time.monotonic()))
            process.send_signal(number)
        out, err = process.communicate(timeout=TIMEOUT_S)
        return Ended(process.returncode, out or "", err or "", time.monotonic() - begin)


def without_checkpoint(found: State) -> State:
    """A state without checkpoints: each of a run's is a valid one, and they are checked by resuming."""
    return {name: data for name, data in found.items() if not name.startswith("checkpoint")}


def holds(command: Command, found: State, whole: State) -> bool:
    """Whether a run that was ended may leave this: nothing or all of an output, or what is done."""
    return is_part(found, whole) if command.goes_on else each_in(found, {}, whole)


def kill(bench: Bench, command: Command, moments: Sequence[float]) -> Row:
    """kill -9 at parts (0 to 1) of a run that makes a new output; then a run to its end."""
    row = Row(command.name, "kill -9, new output")
    whole, seconds = bench.whole(command)
    desk = bench.desk()
    for moment in moments:
        ended = bench.run(bench.arguments(command, desk), (signal.SIGKILL, moment * seconds))
        row.runs += 1
        row.finished += ended.code in command.codes
        found = without_stages(without_checkpoint(state(desk)))
        row.check(holds(command, found, whole), f"at {moment:.3f}: half an output: {sorted(found)}")
        _check_checkpoint(row, desk)
        if found and (found == whole or not command.goes_on):
            shutil.rmtree(desk)
            desk.mkdir()
        elif (desk / "checkpoint.npz").exists():
            (desk / "checkpoint.npz").unlink()
    _check_next_run(bench, command, desk, row, whole)
    return row


def kill_overwriting(bench: Bench, command: Command, moments: Sequence[float]) -> Row:
    """kill -9 while an earlier output is replaced, with somebody's notes in it."""
    row = Row(command.name, "kill -9, --overwrite")
    whole, seconds = bench.whole(command)
    older, _ = bench.whole(command, *command.older)
    notes: State = {}
    desk = bench.desk()

    def lay_out() -> None:
        bench.lay_out(desk, command, *command.older)
        if command.output is not None and (desk / command.output).is_dir():
            notes[f"{command.output}/notes.txt"] = b"dear"
            (desk / command.output / "notes.txt").write_bytes(b"dear")

    lay_out()
    for moment in moments:
        arguments = bench.arguments(command, desk, "--overwrite")
        ended = bench.run(arguments, (signal.SIGKILL, moment * seconds))
        row.runs += 1
        row.finished += ended.code in command.codes
        found = without_stages(state(desk))
        row.check(each_in(found, {**older, **notes}, {**whole, **notes}), f"at {moment:.3f}: {sorted(found)}")
        if found != {**older, **notes}:
            lay_out()
    _check_next_run(bench, command, desk, row, {**whole, **notes})
    return row


def ended_by(bench: Bench, command: Command, number: int, moments: Sequence[float]) -> Row:
    """A signal that asks to end, at parts (0 to 1) of a run."""
    row = Row(command.name, signal.Signals(number).name)
    whole, seconds = bench.whole(command)
    desk = bench.desk()
    for moment in moments:
        ended = bench.run(bench.arguments(command, desk), (number, moment * seconds))
        row.runs += 1
        found = state(desk)
        left = without_checkpoint(found)
        row.check(holds(command, left, whole), f"at {moment:.3f}: left {sorted(found)}")
        _check_checkpoint(row, desk)
        if ended.code in command.codes:
            row.finished += 1
            row.check(without_checkpoint(found) == whole, f"at {moment:.3f}: {ended.code} without an output")
        elif ended.code != ENDED[signal.Signals(number)] and _before_the_program(ended, number):
            row.early += 1
            row.check(not found, f"at {moment:.3f}: left {sorted(found)}")
        else:
            row.check(ended.code == ENDED[signal.Signals(number)], f"at {moment:.3f}: exit code {ended.code}")
            row.check("Traceback" not in ended.err, f"at {moment:.3f}: {ended.err[-300:]}")
        shutil.rmtree(desk)
        desk.mkdir()
    return row


def full_disk(bench: Bench, command: Command, limits: Sequence[int]) -> Row:
    """No file may grow beyond a limit, and, where a small file system can be mounted, that is full."""
    row = Row(command.name, "disk full")
    whole, _ = bench.whole(command)
    for limit in limits:
        desk = bench.desk()
        _check_full(row, command, desk, bench.run(bench.arguments(command, desk), limit=limit), whole)
    desk = bench.desk()
    with mounted(desk, "size=16k") as done:
        if done:
            _check_full(row, command, desk, bench.run(bench.arguments(command, desk)), whole)
    return row


def read_only(bench: Bench, command: Command) -> Row:
    """A place where nothing can be made: /proc, and, where one can be mounted, a read-only file system."""
    row = Row(command.name, "read-only")
    desk = bench.desk()
    _check_refused(row, Path("/proc"), bench.run(bench.arguments(command, Path("/proc"))))
    with mounted(desk, "ro") as done:
        if done:
            _check_refused(row, desk, bench.run(bench.arguments(command, desk)))
    return row


def streams(bench: Bench, command: Command) -> Row:
    """stdout and stderr closed, full, or a pipe without a reader."""
    row = Row(command.name, "streams")
    whole, _ = bench.whole(command)
    for name, code in (("full", 2), ("closed", 2), ("reader gone", READER_GONE)):
        desk = bench.desk()
        with broken_stream(name) as stream:
            ended = bench.run(bench.arguments(command, desk), stdout=stream)
        row.runs += 1
        fails = command.prints or command.name == "track"
        codes = (code,) if fails else command.codes
        row.check(ended.code in codes, f"stdout {name}: exit code {ended.code}, expected {codes}")
        row.check("Traceback" not in ended.err and "Exception ignored" not in ended.err, ended.err[-300:])
        found = without_checkpoint(state(desk))
        row.check(
            found == whole or (command.name == "track" and not found), f"stdout {name}: {sorted(found)}"
        )
        desk = bench.desk()
        with broken_stream(name) as stream:
            ended = bench.run(bench.arguments(command, desk), stderr=stream)
        row.runs += 1
        row.check(ended.code in command.codes, f"stderr {name}: exit code {ended.code}")
        row.check(without_checkpoint(state(desk)) == whole, f"stderr {name}: {sorted(state(desk))}")
    return row


def two_writers(bench: Bench, command: Command, times: int) -> Row:
    """Two runs of one command that write one output, a little apart."""
    row = Row(command.name, "two writers")
    whole, seconds = bench.whole(command)
    for apart in np.linspace(0.0, 0.8, times) * seconds:
        desk = bench.desk()
        first = bench.start(bench.arguments(command, desk))
        time.sleep(apart)
        second = bench.start(bench.arguments(command, desk))
        ends = [(one, *one.communicate(timeout=TIMEOUT_S)) for one in (first, second)]
        row.runs += 1
        codes = sorted(one.returncode in command.codes for one, _, _ in ends)
        after = command.shared or (command.goes_on and apart > 0.7 * seconds)  # the first has ended
        row.check(
            codes == [False, True] or (after and all(codes)),
            f"{apart:.2f} s apart: {[one.returncode for one, _, _ in ends]}",
        )
        for one, _, err in ends:
            refused = one.returncode == 2 and err.count("\n") == 1
            row.check(one.returncode in command.codes or refused, f"{apart:.2f} s apart: {err[-300:]}")
        found = without_checkpoint(state(desk))
        row.check(found == whole, f"{apart:.2f} s apart: {sorted(found)}")
    return row


def resume(bench: Bench, command: Command, moments: Sequence[float]) -> Row:
    """A tracker that is killed and resumed, again and again, says what an unbroken one says."""
    row = Row(command.name, "kill -9 and --resume")
    desk = bench.desk()
    unbroken = bench.run(bench.arguments(command, desk))
    lines = unbroken.out.splitlines()
    whole, seconds = without_checkpoint(state(desk)), unbroken.seconds
    for moment in moments:
        desk = bench.desk()
        killed = bench.run(bench.arguments(command, desk), (signal.SIGKILL, moment * seconds))
        row.runs += 1
        row.finished += killed.code in command.codes
        said = [line for line in killed.out.splitlines(keepends=True) if line.endswith("\n")]
        row.check([line.rstrip("\n") for line in said] == lines[: len(said)], f"at {moment:.3f}: other lines")
        resumed = bench.run(bench.arguments(command, desk, "--resume", "--overwrite"))
        again = resumed.out.splitlines()
        row.check(resumed.code in command.codes, f"at {moment:.3f}: {resumed.err[-300:]}")
        row.check(again == lines[len(lines) - len(again) :], f"at {moment:.3f}: resumed to other lines")
        row.check(len(said) + len(again) >= len(lines), f"at {moment:.3f}: lines are missing")
        row.check(without_checkpoint(state(desk)) == whole, f"at {moment:.3f}: another result")
    return row


@contextmanager
def mounted(folder: Path, options: str) -> Iterator[bool]:
    """A small file system mounted on a folder; False where that is not allowed."""
    command = ["mount", "-t", "tmpfs", "-o", options, "none", str(folder)]
    try:
        done = subprocess.run(command, capture_output=True, check=False).returncode == 0
    except OSError:
        done = False
    try:
        yield done
    finally:
        if done:
            subprocess.run(["umount", str(folder)], check=True)


@contextmanager
def broken_stream(kind: str) -> Iterator[int]:
    """A stream that cannot be written: a full one, a pipe that nobody reads, one not open for writing."""
    if kind == "reader gone":
        reader, writer = os.pipe()
        os.close(reader)
    else:
        writer = os.open(
            "/dev/full" if kind == "full" else os.devnull, os.O_RDWR if kind == "full" else os.O_RDONLY
        )
    try:
        yield writer
    finally:
        os.close(writer)


def _check_checkpoint(row: Row, desk: Path) -> None:
    path = desk / "checkpoint.npz"
    if path.exists():
        try:
            Tracker.load(path)
        except SstGraphError as error:
            row.failures.append(str(error))


def _check_next_run(bench: Bench, command: Command, desk: Path, row: Row, whole: State) -> None:
    """A run to its end makes the output and removes what the killed ones left."""
    stands = command.output is not None and (desk / command.output).exists() and not command.goes_on
    standing = ["--overwrite"] if stands else []
    ended = bench.run(bench.arguments(command, desk, *standing))
    row.check(ended.code in command.codes, f"the next run: {ended.code} {ended.err[-300:]}")
    found = without_checkpoint(state(desk))
    row.check(found == whole, f"the next run leaves {sorted(set(found) ^ set(whole))} or other content")


def _check_full(row: Row, command: Command, desk: Path, ended: Ended, whole: State) -> None:
    row.runs += 1
    found = without_checkpoint(state(desk))
    if ended.code in command.codes:
        row.finished += 1
        as_it_may_be = found == whole or (command.goes_on and is_part(found, whole))
        row.check(as_it_may_be, f"finished with {sorted(found)}")
        return
    row.check(ended.code == 2, f"exit code {ended.code}: {ended.err[-300:]}")
    row.check(found != whole and holds(command, found, whole), f"left {sorted(found)}")
    lines = ended.err.strip().splitlines()
    row.check(bool(lines) and str(desk) in lines[-1], f"the message names no place: {ended.err[-300:]}")
    row.check("Traceback" not in ended.err, ended.err[-300:])


def _check_refused(row: Row, place: Path, ended: Ended) -> None:
    row.runs += 1
    row.check(
        ended.code == 2 and ended.out == "", f"exit code {ended.code}, {len(ended.out)} characters said"
    )
    row.check(ended.err.count("\n") == 1 and str(place) in ended.err, f"not one line: {ended.err[-300:]}")


def _before_the_program(ended: Ended, number: int) -> bool:
    """Whether the interpreter was still on its way to the program's first line."""
    if ended.err == "":
        return ended.code == -number
    own = [line for line in ended.err.splitlines() if "sst_graph/" in line and "__editable__" not in line]
    imports_only = all("sst_graph/__init__.py" in line or "sst_graph/cli/" in line for line in own)
    return "KeyboardInterrupt" in ended.err and imports_only


def table(rows: Sequence[Row]) -> str:
    """Failures of runs in Markdown: a line for each fault, a column for each command."""
    cells = {(row.fault, row.command): f"{len(row.failures)} of {row.runs}" for row in rows}
    commands, faults = (dict.fromkeys(names) for names in zip(*((c, f) for f, c in cells), strict=True))
    head = f"| fault | {' | '.join(f'`{command}`' for command in commands)} |"
    return markdown.table(
        head, ([fault, *(cells.get((fault, command), NONE) for command in commands)] for fault in faults)
    )


def all_rows(bench: Bench, moments: int, chosen: Sequence[str], commands: Sequence[str]) -> Iterator[Row]:
    """The whole matrix, row by row."""
    random = np.random.default_rng(20)
    limits = (0, 200, 3_000, 30_000)

    def times() -> list[float]:
        return [float(moment) for moment in random.uniform(0.0, 1.05, moments)]

    for name in commands:
        command = COMMANDS[name]
        if command.output is not None:
            rows: dict[str, list[Callable[[], Row]]] = {
                "kill": [lambda c=command: kill(bench, c, times())],  # type: ignore[misc]
                "full": [lambda c=command: full_disk(bench, c, limits)],  # type: ignore[misc]
                "readonly": [lambda c=command: read_only(bench, c)],  # type: ignore[misc]
                "writers": [lambda c=command: two_writers(bench, c, 4)],  # type: ignore[misc]
            }
            if command.older:
                rows["overwrite"] = [lambda c=command: kill_overwriting(bench, c, times())]  # type: ignore[misc]
            if name == "track":
                rows["resume"] = [lambda c=command: resume(bench, c, times())]  # type: ignore[misc]
        else:
            rows = {}
        rows["signals"] = [
            lambda c=command, n=number: ended_by(bench, c, n, times())  # type: ignore[misc]
            for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
        ]
        rows["streams"] = [lambda c=command: streams(bench, c)]  # type: ignore[misc]
        for kind, makers in rows.items():
            if kind in chosen:
                yield from (make() for make in makers)


KINDS = ("kill", "overwrite", "resume", "signals", "full", "readonly", "streams", "writers")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--moments", type=int, default=50, help="kills and signals of each kind (default 50)")
    parser.add_argument("--rows", default=",".join(KINDS), help="faults (default: all)")
    parser.add_argument("--commands", default=",".join(COMMANDS), help="commands (default: all)")
    parser.add_argument("--out", type=Path, help="file for the table, written again after every row")
    args = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder))
        for row in all_rows(bench, args.moments, args.rows.split(","), args.commands.split(",")):
            rows.append(row)
            print(
                f"{row.command}, {row.fault}: {row.runs} runs ({row.finished} finished before it, "
                f"{row.early} early), {len(row.failures)} failures",
                file=sys.stderr,
            )
            for failure in row.failures[:5]:
                print("   ", failure, file=sys.stderr, flush=True)
            if args.out is not None:
                args.out.write_text(table(rows))
    print(table(rows), end="")
    return int(any(row.failures for row in rows))


if __name__ == "__main__":
    sys.exit(main())
