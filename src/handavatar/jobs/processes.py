"""Other processes of this machine."""

import os


def is_running(process: int) -> bool:
    """Whether a process of this machine is there; where nobody can tell, it is.

    Args:
        process: its number.
    """
    if os.name == "nt":  # where the question would end it
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True  # Another user's.
    return True
