"""The filter of system calls, run by a machine of classic BPF that is written here from the kernel's manual."""

from __future__ import annotations

import errno
import struct

import pytest

from ctgraph_rl.board.system_calls import CALLS, filter_of

X86_64, AARCH64, I386 = 0xC000003E, 0xC00000B7, 0x40000003

ALLOWED, KILLED = "allowed", "killed"


def answer(machine: str, number: int, *arguments: int, abi: int | None = None) -> str:
    """Return what the filter answers to a call: allowed, killed, or the name of an error."""
    program = list(struct.iter_unpack("=HBBI", filter_of(machine)))
    abi = {"x86_64": X86_64, "aarch64": AARCH64}[machine] if abi is None else abi
    data = struct.pack("=IIQ6Q", number, abi, 0, *arguments, *[0] * (6 - len(arguments)))
    register, place = 0, 0
    while True:
        code, if_true, if_false, value = program[place]
        place += 1
        if code == 0x20:
            (register,) = struct.unpack_from("=I", data, value)
        elif code == 0x06:
            return {0x7FFF: ALLOWED, 0x8000: KILLED, 0x0005: errno.errorcode.get(value & 0xFFFF)}[value >> 16]
        else:
            holds = {0x15: register == value, 0x35: register >= value, 0x45: register & value != 0}[code]
            place += if_true if holds else if_false


both = pytest.mark.parametrize(("machine", "column"), [("x86_64", 0), ("aarch64", 1)])


@both
def test_calls_that_no_learner_needs_are_refused_and_others_are_not(machine, column):
    by_arguments = ("ioctl", "socket", "clone", "prctl")
    numbers = {name: columns[column] for name, columns in CALLS.items()}
    answers = {name: answer(machine, number) for name, number in numbers.items() if name not in by_arguments}
    others = set(range(450)) - set(numbers.values())

    assert set(answers.values()) == {"EPERM", "ENOSYS"}
    assert {answers[name] for name in ("mount", "keyctl", "ptrace", "bpf", "userfaultfd", "unshare")} == {"EPERM"}
    assert {answers[name] for name in ("clone3", "memfd_create", "io_uring_setup")} == {"ENOSYS"}
    assert {answer(machine, number) for number in others} == {ALLOWED}


@both
@pytest.mark.parametrize(
    ("name", "arguments", "expected"),
    [
        ("ioctl", (1, 0x5412), "EPERM"),
        ("ioctl", (1, 0x541C), "EPERM"),
        ("ioctl", (1, 0xFFFFFFFF00005412), "EPERM"),  # the kernel reads 32 bits
        ("ioctl", (0x5412, 0x5401), ALLOWED),
        ("socket", (1, 1), ALLOWED),
        ("socket", (2, 1), ALLOWED),
        ("socket", (10, 1), ALLOWED),
        ("socket", (16, 3), ALLOWED),
        ("socket", (17, 3), "EAFNOSUPPORT"),
        ("socket", (40, 1), "EAFNOSUPPORT"),
        ("clone", (0x11,), ALLOWED),
        ("clone", (0x3D0F00,), ALLOWED),  # a thread of glibc
        *(("clone", (flag,), "EPERM") for flag in (0x20000, *(1 << bit for bit in range(25, 31)))),
        ("prctl", (4, 0), "EPERM"),
        ("prctl", (15, 4), ALLOWED),
    ],
)
def test_some_calls_are_refused_by_their_arguments(machine, column, name, arguments, expected):
    assert answer(machine, CALLS[name][column], *arguments) == expected


def test_calls_of_another_abi_are_refused():
    assert answer("x86_64", 3, abi=I386) == KILLED
    assert answer("aarch64", 3, abi=X86_64) == KILLED
    assert answer("x86_64", 0x40000000 + 3) == "ENOSYS"
    assert filter_of("riscv64") is None
