"""The one kind of error that is the user's to mend."""


class UserError(Exception):
    """Bad input: the command line prints the message without a traceback and exits with code 2.

    The message is one line that names the offending value and the remedy.
    """
