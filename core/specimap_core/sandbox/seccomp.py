"""A seccomp filter: system calls that a process which reads files from outside has no use for fail from now on.

Landlock guards paths; this guards what has none: sockets of every kind, signals, other processes' memory, System V
memory and queues, io_uring (which would go around both), and changes to the rights, owner, attributes and times of
files, which a descriptor opened for reading is enough for.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import struct
import sys
from collections.abc import Sequence

from specimap_core.sandbox.landlock import give_up_new_rights, library

# Numbers on x86-64 and on AArch64; None where there is no such call.
_ALWAYS: dict[str, tuple[int | None, int | None]] = {
    "ptrace": (101, 117),
    "process_vm_readv": (310, 270),
    "process_vm_writev": (311, 271),
    "process_madvise": (440, 440),
    "pidfd_open": (434, 434),
    "pidfd_getfd": (438, 438),
    "pidfd_send_signal": (424, 424),
    "kcmp": (312, 272),
    "rt_sigqueueinfo": (129, 138),
    "rt_tgsigqueueinfo": (297, 240),
    "migrate_pages": (256, 238),
    "move_pages": (279, 239),
    "socket": (41, 198),
    "connect": (42, 203),
    "bind": (49, 200),
    "listen": (50, 201),
    "accept": (43, 202),
    "accept4": (288, 242),
    "io_uring_setup": (425, 425),
    "io_uring_enter": (426, 426),
    "io_uring_register": (427, 427),
    "bpf": (321, 280),
    "perf_event_open": (298, 241),
    "userfaultfd": (323, 282),
    "fanotify_init": (300, 262),
    "inotify_add_watch": (254, 27),
    "keyctl": (250, 219),
    "add_key": (248, 217),
    "request_key": (249, 218),
    "mount": (165, 40),
    "umount2": (166, 39),
    "pivot_root": (155, 41),
    "chroot": (161, 51),
    "setns": (308, 268),
    "unshare": (272, 97),
    "mount_setattr": (442, 442),
    "move_mount": (429, 429),
    "open_tree": (428, 428),
    "open_tree_attr": (467, 467),
    "fsopen": (430, 430),
    "fsconfig": (431, 431),
    "fsmount": (432, 432),
    "fspick": (433, 433),
    "open_by_handle_at": (304, 265),
    "name_to_handle_at": (303, 264),
    "init_module": (175, 105),
    "finit_module": (313, 273),
    "delete_module": (176, 106),
    "kexec_load": (246, 104),
    "kexec_file_load": (320, 294),
    "reboot": (169, 142),
    "swapon": (167, 224),
    "swapoff": (168, 225),
    "acct": (163, 89),
    "quotactl": (179, 60),
    "sethostname": (170, 161),
    "setdomainname": (171, 162),
    "settimeofday": (164, 170),
    "clock_settime": (227, 112),
    "adjtimex": (159, 171),
    "clock_adjtime": (305, 266),
    "iopl": (172, None),
    "ioperm": (173, None),
    "syslog": (103, 116),
    "vhangup": (153, 58),
    "setpriority": (141, 140),
    "ioprio_set": (251, 30),
    "sched_setscheduler": (144, 119),
    "sched_setparam": (142, 118),
    "sched_setattr": (314, 274),
    "quotactl_fd": (443, 443),
    "process_mrelease": (448, 448),
    "shmget": (29, 194),
    "shmat": (30, 196),
    "shmctl": (31, 195),
    "semget": (64, 190),
    "semctl": (66, 191),
    "semop": (65, 193),
    "semtimedop": (220, 192),
    "msgget": (68, 186),
    "msgsnd": (69, 189),
    "msgrcv": (70, 188),
    "msgctl": (71, 187),
    "mq_open": (240, 180),
    "mq_unlink": (241, 181),
    "chmod": (90, None),
    "fchmod": (91, 52),
    "fchmodat": (268, 53),
    "fchmodat2": (452, 452),
    "chown": (92, None),
    "fchown": (93, 55),
    "lchown": (94, None),
    "fchownat": (260, 54),
    "setxattr": (188, 5),
    "lsetxattr": (189, 6),
    "fsetxattr": (190, 7),
    "setxattrat": (463, 463),
    "removexattr": (197, 14),
    "lremovexattr": (198, 15),
    "fremovexattr": (199, 16),
    "removexattrat": (466, 466),
    "file_setattr": (469, 469),
    "utime": (132, None),
    "utimes": (235, None),
    "futimesat": (261, None),
    "utimensat": (280, 88),
}
_ALONE: dict[str, tuple[int | None, int | None]] = {
    "execve": (59, 221),
    "execveat": (322, 281),
    "fork": (57, None),
    "vfork": (58, None),
    "kill": (62, 129),
    "tkill": (200, 130),
    "setpgid": (109, 154),
    "setsid": (112, 157),
    "setrlimit": (160, 164),
    "socketpair": (53, 199),
}
_KILL, _TGKILL, _SENDTO, _SOCKETPAIR, _PRLIMIT, _CLONE, _CLONE3, _AFFINITY = (
    (62, 129),
    (234, 131),
    (44, 206),
    (53, 199),
    (302, 261),
    (56, 220),
    (435, 435),
    (203, 122),
)
_MACHINES = {"x86_64": (0, 0xC000003E), "aarch64": (1, 0xC00000B7)}
"""Column of the tables, and the kernel's name for the architecture."""
_X32 = 0x40000000

_LOAD, _EQUAL, _AT_LEAST, _AND, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x54, 0x45, 0x06
_ALLOW, _ERROR, _END = 0x7FFF0000, 0x00050000, 0x80000000
_NUMBER, _ARCHITECTURE = 0, 4
_CLONE_THREAD, _CLONE_NAMESPACES = 0x10000, 0x7E020000
_UNIX, _STREAM = 1, 1
_SET_FILTER, _ALL_THREADS = 1, 1
_SECCOMP = {"x86_64": 317, "aarch64": 277}

Instruction = tuple[int, int, int, int]


def available() -> bool:
    """Whether this machine's calls are known and its kernel filters them."""
    if sys.platform != "linux" or platform.machine() not in _MACHINES:
        return False
    # Asked with no filter, a kernel that knows it complains of the address (EFAULT), one that does not of the call.
    library().syscall(ctypes.c_long(_SECCOMP[platform.machine()]), ctypes.c_long(_SET_FILTER), ctypes.c_long(0), None)
    return ctypes.get_errno() == errno.EFAULT


def restrict(*, alone: bool) -> None:
    """Filter the calls of this process, all its threads and whatever it starts.

    ``alone``: it starts no process either, runs no program, and signals none but itself.

    Raises:
        OSError: the kernel refuses.
    """
    program = _program(alone)
    code = b"".join(struct.pack("=HBBI", *instruction) for instruction in program)
    buffer = ctypes.create_string_buffer(code, len(code))
    filter = struct.pack("@HP", len(program), ctypes.addressof(buffer))
    give_up_new_rights()
    answer = library().syscall(
        ctypes.c_long(_SECCOMP[platform.machine()]), ctypes.c_long(_SET_FILTER), ctypes.c_long(_ALL_THREADS), filter
    )
    if answer:
        code_of_error = ctypes.get_errno()
        raise OSError(code_of_error, f"seccomp: {os.strerror(code_of_error)}")


def _program(alone: bool) -> list[Instruction]:
    column, architecture = _MACHINES[platform.machine()]
    code: list[Instruction] = [
        (_LOAD, 0, 0, _ARCHITECTURE),
        (_EQUAL, 1, 0, architecture),
        (_RETURN, 0, 0, _END),
        (_LOAD, 0, 0, _NUMBER),
    ]
    if column == 0:  # the same calls under other numbers
        code += [(_AT_LEAST, 0, 1, _X32), (_RETURN, 0, 0, _END)]

    def when(number: int | None, tests: Sequence[Instruction], error: int = errno.EPERM) -> None:
        """Refuse a call, where ``tests`` let it through to their end."""
        if number is None:
            return
        body = [*tests, (_RETURN, 0, 0, _ERROR | error), (_LOAD, 0, 0, _NUMBER)]
        code.extend([(_EQUAL, 0, len(body), number), *body])

    for numbers in (*_ALWAYS.values(), *(_ALONE.values() if alone else ())):
        when(numbers[column], ())
    # To a program without it, the older call is as good; its flags can be looked at.
    when(_CLONE3[column], (), errno.ENOSYS)
    # An address of a datagram: none is given by send(2).
    for half in (_low(4), _low(4) + 4):
        when(_SENDTO[column], ((_LOAD, 0, 0, half), (_EQUAL, 1, 0, 0)))
    # A pair of streams leads nowhere else; one of datagrams, which a raw one is too, sends to any address.
    when(_SOCKETPAIR[column], ((_LOAD, 0, 0, _low(0)), (_EQUAL, 1, 0, _UNIX)))
    when(_SOCKETPAIR[column], ((_LOAD, 0, 0, _low(1)), (_AND, 0, 0, 0xF), (_EQUAL, 1, 0, _STREAM)))
    # The processors of another process; its own threads it may bind by the number that means the caller.
    when(_AFFINITY[column], () if alone else ((_LOAD, 0, 0, _low(0)), (_EQUAL, 1, 0, 0)))
    if alone:
        when(_TGKILL[column], ((_LOAD, 0, 0, _low(0)), (_EQUAL, 1, 0, os.getpid())))
        when(_CLONE[column], ((_LOAD, 0, 0, _low(0)), (_ANY_BIT, 1, 0, _CLONE_THREAD)))
        # Its own limits it may ask, and no more.
        for half in (_low(2), _low(2) + 4):
            when(_PRLIMIT[column], ((_LOAD, 0, 0, half), (_EQUAL, 1, 0, 0)))
    else:
        when(_CLONE[column], ((_LOAD, 0, 0, _low(0)), (_ANY_BIT, 0, 1, _CLONE_NAMESPACES)))
        when(_KILL[column], ((_LOAD, 0, 0, _low(0)), (_EQUAL, 0, 1, 0xFFFFFFFF)))
    when(_PRLIMIT[column], ((_LOAD, 0, 0, _low(0)), (_EQUAL, 1, 0, 0)))
    return [*code, (_RETURN, 0, 0, _ALLOW)]


def _low(argument: int) -> int:
    """Where the lower half of an argument lies; both architectures are little-endian."""
    return 16 + 8 * argument
