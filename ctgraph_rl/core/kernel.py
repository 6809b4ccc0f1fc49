"""The C code of the package, `kernel.c`, as a library of functions on tensors.

The C compiler builds it once, into a folder of the user's; without a compiler all else works. The file's name holds the
SHA-256 of its content; a library that differs is built again. The bits are those of the tensor code.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shlex
import stat
import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from ctgraph_rl.checks import require
from ctgraph_rl.disk import publish

ROWS_A_THREAD = 2048


def num_threads(num_rows: int, most: int) -> int:
    """Return the threads to use for a number of rows."""
    return max(1, min(torch.get_num_threads(), most, num_rows // ROWS_A_THREAD))


def takes(*tensors: Tensor) -> bool:
    """Return whether the functions take these tensors: plain int64 or uint8 ones on the CPU, untraced."""
    fits = all(type(each) is Tensor and each.is_cpu and each.dtype in _DTYPES for each in tensors)
    return fits and not is_traced() and is_available()


def is_traced() -> bool:
    """Return whether ``torch.compile``, ``torch.vmap`` or another transform must see tensor code."""
    return (
        torch.compiler.is_compiling()
        or torch.jit.is_tracing()  # type: ignore[attr-defined]  # which its module's __all__ lacks
        or torch._C._functorch.peek_interpreter_stack() is not None
        or torch._C._len_torch_dispatch_stack() > 0
    )


_DTYPES = (torch.int64, torch.uint8)


def philox(words: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """`philox.philox` of the counter's four words and the key's two, int64 that broadcast."""
    shape = torch.broadcast_shapes(*(word.shape for word in words))
    given = [word.long() if word.numel() == 1 else word.long().expand(shape).contiguous() for word in words]
    made = torch.empty(4, *shape, dtype=torch.int64, device="cpu")
    count = made[0].numel()
    library().ctgraph_philox(
        (ctypes.c_void_p * 6)(*(word.data_ptr() for word in given)),
        (ctypes.c_int64 * 6)(*(int(word.numel() > 1) for word in given)),
        ctypes.c_void_p(made.data_ptr()),
        ctypes.c_int64(count),
        ctypes.c_int64(num_threads(count, most=-(-count // _BLOCK))),
    )
    return made.unbind()


def add_noise(images: Tensor, start: Tensor, read_noise: Tensor) -> Tensor:
    """`reading.add_noise`."""
    images = images.contiguous()
    start = start.long().contiguous()
    read_noise = read_noise.long().contiguous()
    made = torch.empty_like(images)
    count = len(images)
    library().ctgraph_noise(
        *(ctypes.c_void_p(each.data_ptr()) for each in (made, images, start, read_noise)),
        ctypes.c_int64(count),
        ctypes.c_int64(images[0].numel()),
        ctypes.c_int64(num_threads(count, most=count)),
    )
    return made


@cache
def is_available() -> bool:
    """Return whether the library exists or can be built; a build fails once in a process."""
    try:
        library()
    except ValueError:
        return False
    return True


_BLOCK = 64
_FLAGS = ("-O3", "-march=native", "-std=gnu11", "-ffp-contract=off", "-fwrapv", "-shared", "-fPIC")


@cache
def library() -> ctypes.CDLL:
    """The functions, compiled if need be.

    Raises:
        ValueError: if compiling fails, with the reason.
    """
    try:
        return _made()
    except (OSError, RuntimeError, AttributeError) as error:
        message = f'kernel="required" cannot make or load the kernel: {error}; use kernel="auto"'
        raise ValueError(message) from error


def _made() -> ctypes.CDLL:
    source = Path(__file__).with_suffix(".c")
    compiler = shlex.split(os.environ.get("CC", "cc"))
    folder = _cache_folder()
    key = _key(source, compiler)
    made = ctypes.CDLL(str(_found(folder, key) or _compiled(source, compiler, folder, key)))
    made.ctgraph_run.restype = ctypes.c_int64
    made.ctgraph_philox.restype = made.ctgraph_noise.restype = None
    return made


def _name(key: str, content: bytes) -> str:
    return f"native-{key}-{hashlib.sha256(content).hexdigest()}.so"


def _found(folder: Path, key: str) -> Path | None:
    for path in folder.glob(f"native-{key}-*.so"):
        with suppress(FileNotFoundError):  # another process has removed it
            _require_own(path)
            if path.name == _name(key, path.read_bytes()):
                return path
            path.unlink()
    return None


def _key(source: Path, compiler: list[str]) -> str:
    try:
        version = subprocess.run([*compiler, "--version"], capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError) as error:
        fix = 'install one (gcc or clang), name it in the environment variable CC, or use kernel="auto"'
        name = shlex.join(compiler)
        raise ValueError(f'kernel="required" needs a C compiler, {name!r} does not run; {fix}') from error
    parts = (source.read_bytes(), repr((compiler, _FLAGS)).encode(), version, _cpu().encode())
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:32]


def _cpu() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    wanted = ("model name", "flags", "Features", "CPU part")
    return repr((platform.machine(), platform.processor(), sorted({x for x in lines if x.startswith(wanted)})))


def _cache_folder() -> Path:
    parent = os.environ.get("XDG_CACHE_HOME")
    folder = (Path(parent) if parent else Path.home() / ".cache") / "ctgraph_rl"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        fix = "name your folder in the environment variable XDG_CACHE_HOME"
        message = f"the compiled kernel is kept in {folder}, which cannot be made ({error}); {fix}"
        raise ValueError(message) from error
    _require_own(folder)
    return folder


def _require_own(path: Path) -> None:
    found = path.stat()
    own = found.st_uid == os.geteuid() and not found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    require((own, f"{path} must belong to this user and be writable by no other; remove it or set XDG_CACHE_HOME"))


def _compiled(source: Path, compiler: list[str], folder: Path, key: str) -> Path:
    """Compile into a separate file that then gets its name, so that processes may do so at once."""
    with tempfile.TemporaryDirectory(dir=folder) as own:
        made = Path(own) / "native.so"
        _compile(source, compiler, made)
        made.chmod(0o700)
        path = folder / _name(key, made.read_bytes())
        publish(made, path)
    return path


def _compile(source: Path, compiler: list[str], made: Path) -> None:
    for openmp in (["-fopenmp"], []):
        command = [*compiler, *_FLAGS, *openmp, str(source), "-o", str(made), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode == 0:
            return
    failed = f'{shlex.join(command)} failed: {done.stderr[-2000:]}; use kernel="auto"'
    raise ValueError(f'kernel="required": {failed}')
