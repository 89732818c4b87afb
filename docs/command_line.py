"""The page of the command line: a table for each command, from the commands themselves."""

import html
from typing import Any

import typer

from qpmhe.cli.app import app

_PAGE, _PLACE = "reference/command-line.md", "<!-- commands -->"


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Put the tables into the page; called by MkDocs."""
    if page.file.src_uri != _PAGE:
        return markdown
    group: Any = typer.main.get_command(app)
    return markdown.replace(
        _PLACE, "\n".join(_section(name, command) for name, command in group.commands.items())
    )


def _section(name: str, command: Any) -> str:
    arguments = [one for one in command.params if one.param_type_name == "argument"]
    usage = " ".join(["qpmhe", name, *(one.name.upper() for one in arguments)])
    rows = [
        f"| {_written(one)} | {_text(one.help)} | {_default(one)} |"
        for one in command.params if one.name != "help"
    ]
    heads = ["| argument or option | what it does | default |", "|---|---|---|"]
    table = heads + rows if rows else []
    return "\n".join([
        f"## qpmhe {name}", "", _text(command.help), "", f"    {usage} [options]", "", *table, "",
    ])


def _written(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return f"`{parameter.name.upper()}`"
    return ", ".join(f"`{name}`" for name in (*parameter.opts, *parameter.secondary_opts))


def _default(parameter: Any) -> str:
    if parameter.required:
        return "required"
    value = parameter.default
    return "" if value is None or value is False or value == "" else f"`{value}`"


def _text(text: str | None) -> str:
    return html.escape(" ".join((text or "").split())).replace("|", "\\|").replace("[", "\\[")
