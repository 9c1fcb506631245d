"""The exceptions of the transmitter's host tool; each carries the exit code the command line ends with."""

from evlcp_sdk.errors import EvlcpError


class DatagramError(ValueError):
    """Bytes that are no datagram, or a payload of another length than its message's; stays in the client."""


class BoardError(EvlcpError):
    """Anything that goes wrong between host and board."""

    exit_code = 6


class NoBoardError(BoardError):
    """No board answers, or more than one could be meant."""

    exit_code = 4


class RefusedError(BoardError):
    """The board refuses a request.

    Args:
        message: What was refused, why, and what to do next.
        status: The board's status code.
        detail: The number that goes with it, 0 if none.
    """

    exit_code = 5

    def __init__(self, message: str, status: int, detail: int = 0) -> None:
        self.status = status
        self.detail = detail
        super().__init__(message)


class LineError(BoardError):
    """No answer after all tries, or the line went away."""


class BoardResetError(LineError):
    """The board forgot this session: it was reset, or another host took over."""


class VerifyError(BoardError):
    """What the board holds is not what was sent."""

    exit_code = 7


class IncompatibleError(BoardError):
    """A board's protocol, or the codebook of a board or a file, is another one than this host's."""

    exit_code = 8


class ToolchainError(BoardError):
    """A compiler or an emulator is missing, or failed."""

    exit_code = 1


class FleetError(BoardError):
    """Some boards of an inventory failed.

    Args:
        message: How many, and what to do next.
        exit_code: The exit code of the first failure.
    """

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code  # type: ignore[misc]
