"""Options that several commands share, each defined once.  Only typer and the standard library are imported here."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer


def scenario_file(text: str) -> Any:
    """Argument that names a scenario file; `text` is its help."""
    return typer.Argument(metavar="SCENARIO.yaml", show_default=False, help=text)


def scenario_changes(example: str) -> Any:
    """Option ``--set`` of the commands that take a scenario; `example` is one key=value of theirs."""
    return typer.Option("--set", metavar="KEY=VALUE", show_default=False, help=f"Change one key, such as {example}; repeatable.")


def folder_of(text: str | Path) -> Path:
    """Folder that the text of an option names: no text is no folder, and the current one is called "." (for `parser` of the option)."""
    if not str(text).strip():
        raise typer.BadParameter(f"found {str(text)!r}, expected a folder; the current folder is .")
    return Path(text)


def out_folder(text: str) -> Any:
    """Option ``--out`` of a folder that is not written unless it is given; `text` is its help."""
    return typer.Option("--out", metavar="DIR", show_default=False, help=text, parser=folder_of)


AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout and nothing else.")]
AnswerFolder = Annotated[Path | None, out_folder("Write JSON and figures into this folder.")]
ShowScenario = Annotated[bool, typer.Option("--print-scenario", help="Print the scenario with all its keys, ready to edit, and stop.")]
