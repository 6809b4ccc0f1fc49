"""A filter of system calls for the code of others: what name spaces do not close off, or no learner needs.

A program of classic BPF, as the kernel runs it before each system call (``seccomp(2)``). It refuses other ABIs of the
processor, keyrings, debugging, the kernel's own programs, mounts, new name spaces, memory without a file, shared memory
of System V, letters typed into a terminal, and sockets other than those of the network and of the file system.
"""

from __future__ import annotations

import errno
import platform
import struct
from collections.abc import Sequence
from typing import NamedTuple

LOAD = 0x20
EQUAL = 0x15
AT_LEAST = 0x35
ANY_BIT = 0x45
RETURN = 0x06
"""Instructions, from linux/bpf_common.h."""

NUMBER_AT = 0
ABI_AT = 4
ARGUMENTS_AT = 16
"""Where the kernel shows the number of the call, the ABI and the arguments, from linux/seccomp.h."""

ALLOW = 0x7FFF0000
REFUSE = 0x00050000
KILL = 0x80000000

X32 = 0x40000000
"""Numbers of the ABI x32, which x86-64 has beside its own, begin here."""

NEW_NAME_SPACES = 0x7E020000
"""Flags of ``clone`` that make name spaces, from linux/sched.h."""

TYPE_A_LETTER = 0x5412
PASTE = 0x541C
"""Requests of ``ioctl`` that put letters into a terminal, as if they were typed there."""

HIDE = 4
"""The option of ``prctl`` that hides a process from who watches it."""

FAMILIES = (1, 2, 10, 16)
"""Sockets of the file system, of IPv4, IPv6 and of the kernel's own tables; a name space closes off all of them."""


CALLS = {
    "add_key": (248, 217),
    "bpf": (321, 280),
    "chroot": (161, 51),
    "clone": (56, 220),
    "clone3": (435, 435),
    "fsconfig": (431, 431),
    "fsmount": (432, 432),
    "fsopen": (430, 430),
    "fspick": (433, 433),
    "io_uring_enter": (426, 426),
    "io_uring_register": (427, 427),
    "io_uring_setup": (425, 425),
    "ioctl": (16, 29),
    "keyctl": (250, 219),
    "memfd_create": (319, 279),
    "memfd_secret": (447, 447),
    "mount": (165, 40),
    "mount_setattr": (442, 442),
    "move_mount": (429, 429),
    "mq_open": (240, 180),
    "msgget": (68, 186),
    "open_tree": (428, 428),
    "perf_event_open": (298, 241),
    "pivot_root": (155, 41),
    "prctl": (157, 167),
    "ptrace": (101, 117),
    "request_key": (249, 218),
    "semget": (64, 190),
    "setns": (308, 268),
    "shmget": (29, 194),
    "socket": (41, 198),
    "syslog": (103, 116),
    "umount2": (166, 39),
    "unshare": (272, 97),
    "userfaultfd": (323, 282),
}
"""Calls that are refused, always or with some arguments: their numbers on x86-64 and on 64-bit ARM."""


class Abi(NamedTuple):
    """How a processor numbers its system calls."""

    id: int  # from linux/audit.h
    column: int  # of `CALLS`
    others_from: int | None = None  # numbers of another ABI begin here


ABIS = {"x86_64": Abi(0xC000003E, 0, X32), "aarch64": Abi(0xC00000B7, 1)}
"""By the names that Python gives to machines."""

BY_ARGUMENTS = ("ioctl", "socket", "clone", "prctl")
"""Calls that are refused only with some arguments."""

MISSING = ("clone3", "memfd_create", "memfd_secret", "io_uring_setup", "io_uring_enter", "io_uring_register", "shmget")
"""Calls that are refused as if this kernel lacked them: libraries then take others."""

Instruction = tuple[int, int, int, int]
"""Code, how many instructions to skip if it holds and if it does not, and the value."""


def filter_of(machine: str | None = None) -> bytes | None:
    """Return the program for a kind of machine, that of this one by default; None where none is known."""
    abi = ABIS.get(platform.machine() if machine is None else machine)
    return None if abi is None else b"".join(struct.pack("=HBBI", *each) for each in _program(abi))


def _program(abi: Abi) -> list[Instruction]:
    """Return the instructions of a program."""
    numbers = {name: columns[abi.column] for name, columns in CALLS.items()}
    found = [(LOAD, 0, 0, ABI_AT), (EQUAL, 1, 0, abi.id), (RETURN, 0, 0, KILL), (LOAD, 0, 0, NUMBER_AT)]
    if abi.others_from is not None:
        found += [(AT_LEAST, 0, 1, abi.others_from), (RETURN, 0, 0, REFUSE | errno.ENOSYS)]
    for name, number in numbers.items():
        if name not in BY_ARGUMENTS:
            reason = errno.ENOSYS if name in MISSING else errno.EPERM
            found += [(EQUAL, 0, 1, number), (RETURN, 0, 0, REFUSE | reason)]
    found += _unless(numbers["socket"], 0, [(EQUAL, family) for family in FAMILIES], errno.EAFNOSUPPORT)
    found += _if(numbers["ioctl"], 1, [(EQUAL, TYPE_A_LETTER), (EQUAL, PASTE)], errno.EPERM)
    found += _if(numbers["clone"], 0, [(ANY_BIT, NEW_NAME_SPACES)], errno.EPERM)
    found += _if(numbers["prctl"], 0, [(EQUAL, HIDE)], errno.EPERM)
    return [*found, (RETURN, 0, 0, ALLOW)]


def _if(number: int, argument: int, tests: Sequence[tuple[int, int]], reason: int) -> list[Instruction]:
    """Return the instructions that refuse a call if one of some tests of an argument holds."""
    skips = [(code, len(tests) - place - 1, 0, value) for place, (code, value) in enumerate(tests)]
    last = skips.pop()
    return _of_call(number, argument, [*skips, (last[0], 0, 1, last[3]), (RETURN, 0, 0, REFUSE | reason)])


def _unless(number: int, argument: int, tests: Sequence[tuple[int, int]], reason: int) -> list[Instruction]:
    """Return the instructions that refuse a call unless one of some tests of an argument holds."""
    skips = [(code, len(tests) - place, 0, value) for place, (code, value) in enumerate(tests)]
    return _of_call(number, argument, [*skips, (RETURN, 0, 0, REFUSE | reason)])


def _of_call(number: int, argument: int, instructions: list[Instruction]) -> list[Instruction]:
    """Return instructions for one call, over the lower half of one of its arguments: the kernel reads no more of it."""
    load = (LOAD, 0, 0, ARGUMENTS_AT + 8 * argument)
    return [(EQUAL, 0, len(instructions) + 2, number), load, *instructions, (LOAD, 0, 0, NUMBER_AT)]
