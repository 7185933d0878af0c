"""The root of every error a user may meet."""

from __future__ import annotations


class CosimError(Exception):
    """Base of all errors of the project: a message of one or two lines that names what is wrong and what to do.

    The command line prints the message alone and exits with ``exit_code``; a traceback only with ``--debug``.
    """

    exit_code: int = 1


class ConfigurationError(CosimError):
    """A file, a field or an option does not describe something that can run; the message names the file and field."""

    exit_code = 2
