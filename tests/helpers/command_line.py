"""Call the command line in this process."""

from __future__ import annotations

from typer.testing import CliRunner, Result

from hybridlio.commands.app import app


def run(*words: object) -> Result:
    """Run a command and return its exit code and output."""
    return CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": "200", "TERM": "dumb"})


def ok(*words: object) -> str:
    """Run a command that must succeed, and return its stdout."""
    result = run(*words)
    assert result.exit_code == 0, result.output
    return result.stdout


def refused(code: int, *words: object) -> str:
    """Run a command that must fail with an exit code, and return the one line of its error."""
    result = run(*words)
    assert result.exit_code == code, result.output
    assert "Traceback" not in result.output
    (line,) = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    return line
