"""Errors that the user can fix."""

__all__ = ["CannotWriteError", "UserError"]


class UserError(Exception):
    """Bad input: the command line prints the message without a traceback and exits with code 2.

    The message is one line that names the offending value and the remedy.
    """


class CannotWriteError(UserError, OSError):
    """A file could not be written. The user can fix that; code that can write elsewhere catches it as an OSError."""

    def __init__(self, message: str, cause: OSError):
        super().__init__(message)
        self.message = message
        self.errno, self.strerror = cause.errno, cause.strerror

    def __str__(self) -> str:
        """The message alone, without OSError's number."""
        return self.message
