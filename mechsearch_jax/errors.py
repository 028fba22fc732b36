"""The one error that a user's input can cause."""


class InputError(ValueError):
    """Bad input from a user: one line that names what is wrong, where, and how to mend it.

    The command line prints the message without a traceback and exits with status 2.
    """
