"""Calls of ``sb3-combrel`` in this process."""

import contextlib
import io

from sb3_combrel import cli


def _status_of(args, output, errors):
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
        try:
            return cli.main([str(arg) for arg in args])
        except SystemExit as error:
            return error.code


def call(*args):
    """Exit status, standard output, and standard error of a call."""
    output, errors = io.StringIO(), io.StringIO()
    return _status_of(args, output, errors), output.getvalue(), errors.getvalue()


def call_for_all_output(*args):
    """Exit status and output of a call, standard output and errors together as a terminal shows them."""
    written = io.StringIO()
    return _status_of(args, written, written), written.getvalue()


def succeed(*args):
    """The standard output of a call that does not fail."""
    status, output, errors = call(*args)
    assert status == 0, errors
    return output


def fail(*args):
    """The one line that a call which fails writes."""
    status, output, errors = call(*args)
    assert status == 1, (output, errors)
    assert errors.startswith("sb3-combrel: ") and errors.count("\n") == 1 and "Traceback" not in output + errors
    return errors
