"""Starts the program in two processes that know of each other, as ``torchrun`` does."""

import os
import socket
import subprocess
import sys

from patience import PATIENCE

PROGRAM = ["-m", "handavatar"]


def begun(program: list[str], words: list[str], **environment: str) -> subprocess.Popen[str]:
    """One process of one thread."""
    return subprocess.Popen(
        [sys.executable, *program, *words],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", **environment},
    )


def two_begun(words: list[str], program: list[str] = PROGRAM) -> list[subprocess.Popen[str]]:
    """What torchrun sets, without its agent, which takes seconds to start."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    return [
        begun(
            program,
            words,
            RANK=str(rank),
            LOCAL_RANK=str(rank),
            WORLD_SIZE="2",
            MASTER_ADDR="127.0.0.1",
            MASTER_PORT=port,
        )
        for rank in range(2)
    ]


def ended(processes: list[subprocess.Popen[str]]) -> tuple[list[int], str]:
    """Exit codes, and all that was printed to standard error."""
    try:
        texts = [process.communicate(timeout=PATIENCE)[1] for process in processes]
    finally:
        for process in processes:
            process.kill()
    return [process.returncode for process in processes], "\n".join(texts)
