"""Portable runs: the same bits on every x86-64 CPU with AVX2, by variables that PyTorch reads when it is imported.

PyTorch, MKL and oneDNN choose their code, and so their rounding, by the CPU, and a run amplifies that. Held to the
code that all these CPUs have, a run depends on none of them.
"""

from __future__ import annotations

import os
import platform
import sys
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from ctgraph_rl.checks import require

VARIABLES = {
    "ATEN_CPU_CAPABILITY": "avx2",  # PyTorch's own loops; its random numbers too
    "MKL_CBWR": "COMPATIBLE",  # products of matrices: MKL's only code with the same bits on Intel's and AMD's CPUs
    "ONEDNN_MAX_CPU_ISA": "AVX2",  # convolutions
}

NEEDED = ("avx2", "fma")
"""Instructions of portable runs; libm takes those of FMA, too."""


class Restart(BaseException):
    """The command must start again; not an error, so that only the entry point handles it."""


_HELD: list[Any] = []


def is_portable() -> bool:
    """Return whether PyTorch was held to portable code by `hold`."""
    return bool(_HELD)


def hold() -> None:
    """Hold PyTorch to portable code in this process, beyond `VARIABLES`.

    oneDNN's LSTM differs between Intel and AMD, so PyTorch's is taken. MKL's square root starts from the CPU's
    approximation and is not rounded correctly; NumPy's is.

    Raises:
        ValueError: as `check_portable`.
    """
    check_portable()
    if _HELD:
        return
    import numpy as np  # here: a command asks before these are imported
    import torch  # here: as above

    torch.backends.mkldnn.set_flags(False)
    functions = torch.library.Library("aten", "IMPL")

    def sqrt(x: Any) -> Any:
        dtype = x.dtype if x.is_floating_point() else torch.get_default_dtype()
        exact = np.sqrt(np.asarray(x.detach().double() if dtype != torch.float32 else x.detach().float()))
        return torch.from_numpy(np.asarray(exact)).to(dtype)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that PyTorch's own function is replaced
        functions.impl("sqrt", sqrt, "CPU")
        functions.impl("sqrt_", lambda x: x.copy_(sqrt(x)), "CPU")
    _HELD.append(functions)


def check_portable() -> None:
    """Refuse a portable run in a process that is not portable.

    Raises:
        ValueError: names missing instructions or variables.
    """
    lacking = _find_lacking()
    variables = " ".join(f"{name}={value}" for name, value in VARIABLES.items())
    require((not lacking, f"portable=true needs an x86-64 CPU with AVX2 and FMA, this one lacks {', '.join(lacking)}"))
    require((_has_variables(), f"portable=true needs these variables before torch is imported: {variables}; set them"))


def become_portable() -> None:
    """Restart the command with `VARIABLES`, unless this process is portable.

    Raises:
        Restart: which the command's entry point answers with `restart`.
        ValueError: for a CPU that lacks instructions.
    """
    if not _has_variables() and not _find_lacking():
        raise Restart
    check_portable()


def restart(environment: Mapping[str, str], arguments: Sequence[str]) -> NoReturn:
    """Start the command again, in the same process, with `VARIABLES` in its environment.

    Raises:
        ValueError: in a process that was started for something else, such as a notebook's.
    """
    if sys.orig_argv[len(sys.orig_argv) - len(arguments) :] != list(arguments):
        check_portable()
    sys.stdout.flush()
    sys.stderr.flush()
    os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], {**environment, **VARIABLES})


def cpu_model() -> str | None:
    """Return the CPU's model, if known."""
    return _read_cpu("model name") or platform.processor() or None


def _has_variables() -> bool:
    return all(os.environ.get(name) == value for name, value in VARIABLES.items())


def _find_lacking() -> list[str]:
    there = _read_cpu("flags").split() if platform.machine() in ("x86_64", "AMD64") else []
    return [name for name in NEEDED if name not in there]


def _read_cpu(field: str) -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.split(":")[0].strip() == field), "")
