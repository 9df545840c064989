"""Render the reference of the command line from the commands themselves.

    python docs/make_cli_reference.py

prints the page that the site shows.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import typer

HEADER = """# Command line

This page is made from the commands each time the site is built; `hybridlio COMMAND --help` prints the same.

Results go to stdout. Progress, warnings and the one line of an error go to stderr.
[Exit codes](../how_to/runs.md#exit-codes) has the table of exit codes. `hybridlio --install-completion` lets the shell
complete commands, options and the names of sources, readers, scenes and the like.
"""


def cli_reference() -> str:
    """Return the page as Markdown: a section for each command, with its usage, arguments and options."""
    from hybridlio.commands.app import app

    group = typer.main.get_command(app)
    context = group.context_class(group, info_name="hybridlio")
    commands: dict[str, Any] = group.commands  # type: ignore[attr-defined]
    rows = [f"| [`{name}`](#{name}) | {first_sentence(command.help)} |" for name, command in commands.items()]
    parts = [HEADER, "\n".join(["| command | |", "| --- | --- |", *rows]) + "\n"]
    parts += [section(name, command, context) for name, command in commands.items()]
    return "\n".join(parts)


def first_sentence(text: str) -> str:
    """Return a help text up to its first full stop or colon, as one line."""
    return escaped(re.split(r"(?<=\.)\s|:\s", " ".join(text.split()))[0].rstrip(".") + ".")


def section(name: str, command: Any, above: Any) -> str:
    """Return the section of one command."""
    context = command.context_class(command, info_name=name, parent=above)
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    options = [p for p in command.params if p.param_type_name == "option"]
    usage = " ".join(
        ["hybridlio", name, *(["[OPTIONS]"] if options else []), *(p.make_metavar(context) for p in arguments)]
    )
    help_text = "\n\n".join(" ".join(paragraph.split()) for paragraph in re.split(r"\n\s*\n", command.help))
    parts = [f"## {name}", f"```text\n{usage}\n```", help_text.replace("``", "`")]
    parts += ["\n".join(table("argument", arguments, context))] if arguments else []
    parts += ["\n".join(table("option", options, context))] if options else []
    return "\n\n".join(parts) + "\n"


def table(kind: str, parameters: list[Any], context: Any) -> Iterator[str]:
    """Yield the rows of a table of arguments or options."""
    yield f"| {kind} | meaning |"
    yield "| --- | --- |"
    for parameter in parameters:
        names = ", ".join(f"`{name}`" for name in (*parameter.opts, *parameter.secondary_opts))
        if kind == "argument":
            names = f"`{parameter.make_metavar(context)}`"
        elif not (parameter.is_flag or parameter.count):
            names += f" `{parameter.make_metavar(context)}`"
        yield f"| {names} | {escaped(parameter.help or '')}{default(parameter)} |"


def default(parameter: Any) -> str:
    """Return the default of an option as the end of its description; nothing where it is off or not set."""
    value = parameter.default
    if parameter.param_type_name == "argument" or not parameter.show_default or value in (None, False, (), [], ""):
        return ""
    return "" if callable(value) or not str(value).strip() else f" Default: `{value}`."


def escaped(text: str) -> str:
    """Return text that Markdown shows as it is in the cell of a table; what is in backticks stays code."""
    parts = " ".join(text.split()).split("`")
    return "`".join(part if k % 2 else re.sub(r"([<>|*])", r"\\\1", part) for k, part in enumerate(parts))


if __name__ == "__main__":
    print(cli_reference())
