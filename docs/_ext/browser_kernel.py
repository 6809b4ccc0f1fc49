"""Build ``docs/_static/play/kernel.js``: the C kernel as WebAssembly, and images of the paper for it.

``python docs/_ext/browser_kernel.py`` needs clang 14 and three more packages of Debian: ``PACKAGES``. The kernel is
`ctgraph_rl/core/kernel.c`, as every other program of this package compiles it.
"""

from __future__ import annotations

import base64
import hashlib
import subprocess
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / "ctgraph_rl" / "core" / "kernel.c"
MADE = ROOT / "docs" / "_static" / "play" / "kernel.js"

COMPILER = "clang-14"
PACKAGES = ("clang-14", "lld-14", "wasi-libc", "libclang-rt-14-dev-wasm32")

OPTIONS = (
    *("--target=wasm32-wasi", "-Oz", "-fwrapv", "-ffp-contract=off", "-w", "-nostartfiles", "-Wl,--no-entry"),
    *("-Wl,--export=ctgraph_run", "-Wl,--export=malloc", "-Wl,--strip-all"),
)
"""Wrapping and unfused arithmetic as everywhere; small, as the module is part of a page."""

NUM_IMAGES, IMAGE_SEED = 256, 1

TEXT = """// Made by docs/_ext/browser_kernel.py from ctgraph_rl/core/kernel.c and the images of the paper; do not edit.
"use strict";
const KERNEL = {{
  compiler: "{compiler}",
  source: "{source}",
  module: "{module}",
  images: "{images}",
  wasm: "{wasm}",
}};
"""
"""``source`` and ``module`` are SHA-256 of the C file and of the compiled one."""


def compiled() -> bytes:
    """Return the kernel as WebAssembly.

    Raises:
        OSError: without the compiler.
        subprocess.CalledProcessError: if it fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "kernel.wasm"
        subprocess.run([COMPILER, *OPTIONS, "-o", str(made), str(SOURCE)], check=True)
        return made.read_bytes()


def compiler() -> str:
    """Return the compiler and its version."""
    said = subprocess.run([COMPILER, "--version"], check=True, capture_output=True, text=True).stdout
    return said.splitlines()[0]


def sha256(content: bytes) -> str:
    """Return the SHA-256 in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def text() -> str:
    """Return the content of the file."""
    from ctgraph_rl.tasks.images import PaperImages

    wasm = compiled()
    images = PaperImages(NUM_IMAGES, IMAGE_SEED).images.numpy().tobytes()
    return TEXT.format(
        compiler=compiler(),
        source=sha256(SOURCE.read_bytes()),
        module=sha256(wasm),
        images=base64.b64encode(images).decode(),
        wasm=base64.b64encode(wasm).decode(),
    )


if __name__ == "__main__":
    MADE.write_text(text(), encoding="utf-8")
    print(f"{MADE}: {MADE.stat().st_size:,} bytes")
