"""Outputs that are whole or do not appear, whatever stops the program.

What is promised of a name NAME that is written through this package:

- Everything is first written in a staging folder beside it (``.NAME.sst-graph-partial``, the same file
  system), flushed to the disk, and takes its name in one step of the operating system. A file is
  renamed or linked, a new folder renamed, a folder that is replaced is *exchanged* with the new one
  (``renameat2`` on Linux, ``renamex_np`` on macOS). At any instant, also of a kill -9 or a loss of
  power, NAME is what it was or what it is to be.
- Where the file system offers no exchange (some network file systems), a folder is replaced by two
  renames. A kill between them leaves the earlier folder whole in the staging folder; the next run that
  writes NAME puts it back first.
- The staging folder is locked (``flock``) as long as its process lives: a second writer of the same name
  is refused before its work begins, and what a killed one left is removed by the next one.
- A folder carries a manifest of what was written into it. Only a folder with one of the same kind is
  replaced; what else stands in it, or was changed since, survives there.
- Without permission to replace, what another program put under NAME meanwhile stays; the finished work
  is then put beside it, under the next free name.
"""

from sst_graph.files.manifest import MANIFEST, OutputKind
from sst_graph.files.output import (
    OutputFile,
    atomic_directory,
    atomic_write_bytes,
    atomic_write_in_steps,
    atomic_write_text,
    output_file,
)
from sst_graph.files.staging import abandon_all, sweep_folder, when_safe
from sst_graph.files.targets import TEXT, OutputFileKind, check_file_target, check_folder_target

__all__ = [
    "MANIFEST",
    "TEXT",
    "OutputFile",
    "OutputFileKind",
    "OutputKind",
    "abandon_all",
    "atomic_directory",
    "atomic_write_bytes",
    "atomic_write_in_steps",
    "atomic_write_text",
    "check_file_target",
    "check_folder_target",
    "output_file",
    "sweep_folder",
    "when_safe",
]
