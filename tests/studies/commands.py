"""The command line, called."""

from typer.testing import CliRunner

from qpmhe.cli.app import app


def command(*words):
    """Output of a command, in one line; its error is raised."""
    answer = CliRunner().invoke(app, [str(word) for word in words])
    if answer.exception is not None:
        raise answer.exception
    return " ".join(answer.output.split())
