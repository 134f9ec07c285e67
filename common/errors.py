"""Errors that a user can act on: one line that names the input and the remedy."""


class CongraspError(Exception):
    """Bad input or a broken surrounding, said in one line.

    Attributes:
      exit_code: what the command line returns to the shell for this error.
    """

    exit_code = 2

    def __init__(self, what: str, remedy: str = ""):
        super().__init__(f"{what} {remedy}".strip().replace("\n", " "))


class PhysicsError(CongraspError):
    """The simulation produced values that are not finite."""

    exit_code = 3


class TransportError(CongraspError):
    """A peer did not answer within its deadline, or refused."""

    exit_code = 4
