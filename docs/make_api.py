"""Makes the pages of the API from signatures and docstrings.

``python docs/make_api.py > docs/reference/api.md`` prints the list of names; the build of the site
adds a page for each section, with the whole docstrings.
"""

from __future__ import annotations

import dataclasses
import enum
import importlib
import inspect
import re
from pathlib import Path
from typing import Any

import sst_graph
from sst_graph.config import Settings

MOST_ARGUMENTS = 7

SECTIONS: dict[str, list[str]] = {
    "Data": [
        "sst_graph.open_source",
        "sst_graph.Source",
        "sst_graph.Frame",
        "sst_graph.Scan",
        "sst_graph.CameraImage",
        "sst_graph.PinholeCamera",
        "sst_graph.SemanticClass",
    ],
    "Calibration of drives": [
        "sst_graph.calibrate",
        "sst_graph.CalibrationConfig",
        "sst_graph.CalibrationResult",
        "sst_graph.Calibration",
        "sst_graph.read_result",
        "sst_graph.inspect_result",
    ],
    "Several cameras": [
        "sst_graph.calibrate_rig",
        "sst_graph.KnownRig",
        "sst_graph.KnownPose",
        "sst_graph.RigResult",
        "sst_graph.read_rig",
    ],
    "Frame by frame": ["sst_graph.Tracker", "sst_graph.TrackerConfig", "sst_graph.TrackUpdate"],
    "In a graph of your own": [
        "sst_graph.AlignmentTerm",
        "sst_graph.TermConfig",
        "sst_graph.AlignmentKeys",
        "sst_graph.Trajectory",
        "sst_graph.follow_objects",
        "sst_graph.solve_with_terms",
        "sst_graph.RematchConfig",
        "sst_graph.WarningKind",
        "sst_graph.IncrementalTerms",
        "sst_graph.calibration_covariance",
        "sst_graph.align_frame",
        "sst_graph.CameraCalibration",
        "sst_graph.ScanMotion",
        "sst_graph.FrameMatching",
    ],
    "Marginals and formats": ["sst_graph.CalibrationMarginal"],
}
"""Public names by section; the others of ``sst_graph.export`` and ``sst_graph.factors`` follow in lists."""


def main() -> None:
    """Print the page."""
    print("# Public API\n")
    print("Made by `python docs/make_api.py > docs/reference/api.md`. Signs, frames and units:")
    print("[conventions](../understand/conventions.md); terms: [glossary](glossary.md);")
    print("settings: [settings](settings.md).")
    print("On the site, the pages below *API by section* have the whole docstrings.")
    for title, names in SECTIONS.items():
        print(f"\n## {title}\n")
        for name in names:
            print("\n".join(entry(name)))
        if title == "Marginals and formats":
            print("\n".join(listed("sst_graph.export", {"CalibrationMarginal"})))
    print("\n## Factors (`sst_graph.factors`)\n")
    print("\n".join(listed("sst_graph.factors", {"PinholeCamera"})))


def write_section_pages(folder: Path) -> None:
    """A page of docstrings for each section, read by Sphinx's autodoc."""
    folder.mkdir(exist_ok=True)
    sections = {title: names for title, names in SECTIONS.items() if title != "Marginals and formats"}
    sections["Marginals and formats"] = [f"sst_graph.export.{name}" for name in public("sst_graph.export")]
    factors = [name for name in public("sst_graph.factors") if name != "PinholeCamera"]  # it stands in Data
    sections["Factors"] = [f"sst_graph.factors.{name}" for name in factors]
    for title, names in sections.items():
        text = "\n".join([f"# {title}\n", "```{eval-rst}", *(directive(name) for name in names), "```", ""])
        page = folder / f"{title.lower().replace(' ', '-')}.md"
        if not page.is_file() or page.read_text(encoding="utf-8") != text:
            page.write_text(text, encoding="utf-8")


def public(package: str) -> list[str]:
    """The public functions and classes of a package."""
    names = sorted(importlib.import_module(package).__all__, key=str.lower)
    things = {name: found(f"{package}.{name}") for name in names}
    return [name for name, thing in things.items() if inspect.isclass(thing) or inspect.isfunction(thing)]


def directive(path: str) -> str:
    """Autodoc's directive for a class or a function."""
    kind = "class" if inspect.isclass(found(path)) else "function"
    return f".. auto{kind}:: {path}\n"


def entry(path: str) -> list[str]:
    """A name with its signature and first line, and below it the public methods of a class."""
    thing = found(path)
    lines = [f"- `{signature(path, thing)}`<br>{first_line(thing)}"]
    if inspect.isclass(thing) and not issubclass(thing, enum.Enum):
        methods = ", ".join(f"`{name}`" for name in methods_of(thing))
        if methods:
            lines.append(f"  <br>{methods}")
    return lines


def listed(package: str, but: set[str]) -> list[str]:
    """The public functions and classes of a package, each with its first line."""
    names = [name for name in public(package) if name not in but]
    return [f"- `{name}`: {first_line(found(f'{package}.{name}'))}" for name in names]


def found(path: str) -> Any:
    package, _, name = path.rpartition(".")
    return getattr(importlib.import_module(package), name)


def signature(path: str, thing: Any) -> str:
    """The call; of what only the package itself makes, and of settings, the name alone."""
    name = path.removeprefix("sst_graph.")
    if inspect.isclass(thing) and (issubclass(thing, enum.Enum) or thing is sst_graph.Source):
        return name
    if len(inspect.signature(thing).parameters) > MOST_ARGUMENTS and inspect.isclass(thing):
        return name
    call = inspect.signature(thing)
    text = name + str(call.replace(parameters=[shortened(one) for one in call.parameters.values()]))
    text = re.sub(r"(: |-> )'([^']*)'", r"\1\2", text.removesuffix(" -> 'None'").removesuffix(" -> None"))
    return text.replace("NDArray[np.", "NDArray[").replace("<factory>", "...").replace("Ellipsis", "...")


def shortened(parameter: inspect.Parameter) -> inspect.Parameter:
    """The parameter, its default as ``...`` where it is more than a word or a number."""
    if parameter.default is parameter.empty or isinstance(parameter.default, str | int | float | None):
        return parameter
    return parameter.replace(default=... if parameter.default else parameter.default)


def first_line(thing: Any) -> str:
    """The first sentence of the docstring, without the marks of references."""
    paragraph = " ".join((inspect.getdoc(thing) or "").split("\n\n")[0].splitlines())
    sentence = re.split(r"(?<=[a-z\])`])\. (?=[A-Z])", paragraph)[0]
    return re.sub(r":\w+:`~?([^`]*)`", r"`\1`", sentence).replace("``", "`")


def methods_of(cls: type) -> list[str]:
    """Fields of a dataclass that has too many for a signature, then public methods and properties.

    The fields of settings have a page of their own.
    """
    fields = [field.name for field in dataclasses.fields(cls)] if dataclasses.is_dataclass(cls) else []
    own = [name for name, member in vars(cls).items() if not name.startswith("_") and is_method(member)]
    if len(fields) <= MOST_ARGUMENTS or issubclass(cls, Settings):
        fields = []
    return [*fields, *(f"{name}()" if callable(getattr(cls, name)) else name for name in own)]


def is_method(member: Any) -> bool:
    return inspect.isfunction(member) or isinstance(member, property | staticmethod | classmethod)


if __name__ == "__main__":
    main()
