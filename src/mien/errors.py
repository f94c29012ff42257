"""Errors that the user can fix."""

__all__ = ["CannotWriteError", "UserError"]


_MOST_SHOWN = 2000
"""Most characters of a message. Values in it may come from a stranger's file."""
_END = 600
"""Number of characters at the end of a longer message that are kept: the remedy is there."""


class UserError(Exception):
    """Bad input: the command line prints the message without a traceback and exits with code 2.

    The message is one line that names the offending value and the remedy. A value of thousands of characters is
    shortened here, so that no reader of files has to.
    """

    def __init__(self, message: str = ""):
        if len(message) > _MOST_SHOWN:
            message = f"{message[: _MOST_SHOWN - _END]} ... {message[-_END:]}"
        super().__init__(message)


class CannotWriteError(UserError, OSError):
    """A file could not be written. The user can fix that; code that can write elsewhere catches it as an OSError."""

    def __init__(self, message: str, cause: OSError):
        super().__init__(message)
        self.message = self.args[0]
        self.errno, self.strerror = cause.errno, cause.strerror

    def __str__(self) -> str:
        """The message alone, without OSError's number."""
        return self.message
