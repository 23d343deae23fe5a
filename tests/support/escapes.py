"""Ways out of a process that has been taken over, each tried: what a hostile file would do if its reader obeyed it.

Its text is run inside the process under test, so it imports nothing of ours. ``tried`` gives for each way ``out``
where it leads out, else the error that stopped it.
"""

from __future__ import annotations

import ctypes
import os
import socket
import sqlite3
import stat
import struct
import subprocess
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

LIBRARY = ctypes.CDLL(None, use_errno=True)
PROCESS_VM_READV = 310 if os.uname().machine == "x86_64" else 270
PIDFD_OPEN, IO_URING_SETUP, FILE_SETATTR, PTRACE_SEIZE = 434, 425, 469, 0x4206


def _called(answer: int) -> None:
    if answer < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def _bytes(path: str | Path) -> None:
    with open(path, "rb") as file:
        if not file.read(1):
            raise OSError(0, "empty")


def _in_thread(call: Callable[[], object]) -> None:
    caught: list[BaseException] = []

    def run() -> None:
        try:
            call()
        except BaseException as error:
            caught.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    if caught:
        raise caught[0]


def _connected(family: int, kind: int, address: Any) -> None:
    with socket.socket(family, kind) as end:
        if kind == socket.SOCK_DGRAM:
            end.sendto(b"x", address)
        else:
            end.connect(address)


def _pair_turned(address: str) -> None:
    one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with one, other:
        one.sendto(b"x", address)


def _pair_of(kind: int, address: str) -> None:
    one, other = socket.socketpair(socket.AF_UNIX, kind)
    with one, other:
        one.sendmsg([b"x"], [], 0, address)


def _with_open(path: Path, change: Callable[[int], object]) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        change(handle)
    finally:
        os.close(handle)


def _queued(queue: int) -> None:
    message = struct.pack("l", 1) + b"x"
    _called(LIBRARY.msgsnd(queue, message, 1, os.O_NONBLOCK))


def _attributes_set(path: str) -> None:
    # 24 bytes of zeros stand for none of them.
    _called(LIBRARY.syscall(FILE_SETATTR, -100, path.encode(), ctypes.create_string_buffer(24), 24, 0))


def _bound() -> None:
    with socket.socket() as end:
        end.bind(("127.0.0.1", 0))
        end.listen()


def _block_device() -> None:
    for path in Path("/dev").iterdir():
        if stat.S_ISBLK(path.lstat().st_mode):
            return _bytes(path)
    raise OSError(0, "there is none")


def _rows(database: str) -> None:
    with sqlite3.connect(f"file:{database}?mode=ro", uri=True) as connection:
        connection.execute("SELECT name FROM sqlite_master").fetchall()


def _read_through_link(secret: str, own: Path) -> None:
    os.link(secret, own / "hard")
    _bytes(own / "hard")


def _memory_of(pid: int) -> None:
    buffer = ctypes.create_string_buffer(8)
    here = struct.pack("PP", ctypes.addressof(buffer), 8)
    there = struct.pack("PP", ctypes.addressof(buffer), 8)
    _called(LIBRARY.syscall(PROCESS_VM_READV, pid, here, 1, there, 1, 0))


def _as_another() -> None:
    os.seteuid(os.getuid() + 1)
    os.seteuid(os.getuid())


def _limited(pid: int) -> None:
    import resource

    resource.prlimit(pid, resource.RLIMIT_CORE, (0, 0))


def _ran(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True, timeout=20)


def ways(told: dict[str, Any]) -> dict[str, Callable[[], object]]:
    """``told``: secret, elsewhere (a folder), database, parent (process id), tcp and udp (ports), unix (a socket's
    path), abstract (its name), datagrams (another's path), queue (number of a System V message queue), own (a folder to
    write), link (a symbolic link to the secret that the reader was given), with a file ``plain`` next to it.
    """
    secret, elsewhere, parent = told["secret"], Path(told["elsewhere"]), told["parent"]
    own, plain = Path(told["own"]), Path(told["link"]).with_name("plain")
    stream, datagram = socket.SOCK_STREAM, socket.SOCK_DGRAM
    return {
        "read a file of the same user": lambda: _bytes(secret),
        "read it by a relative path": lambda: _bytes(os.path.relpath(secret)),
        "read it in another thread": lambda: _in_thread(lambda: _bytes(secret)),
        "read it by /proc/self/root": lambda: _bytes(f"/proc/self/root{secret}"),
        "read it by the parent's root": lambda: _bytes(f"/proc/{parent}/root{secret}"),
        "read it by a symbolic link": lambda: _bytes(told["link"]),
        "read it by a hard link": lambda: _read_through_link(secret, own),
        "read it by another program": lambda: _ran("/bin/cat", secret),
        "list its folder": lambda: os.listdir(elsewhere),
        "read the database": lambda: _rows(told["database"]),
        "read /etc/shadow": lambda: _bytes("/etc/shadow"),
        "read a disk": _block_device,
        "read the parent's environment": lambda: _bytes(f"/proc/{parent}/environ"),
        "list the parent's open files": lambda: os.listdir(f"/proc/{parent}/fd"),
        "open the parent's memory": lambda: os.close(os.open(f"/proc/{parent}/mem", os.O_RDONLY)),
        "read the parent's memory": lambda: _memory_of(parent),
        "trace the parent": lambda: _called(LIBRARY.ptrace(PTRACE_SEIZE, parent, None, None)),
        "signal the parent": lambda: os.kill(parent, 0),
        "get hold of the parent": lambda: _called(LIBRARY.syscall(PIDFD_OPEN, parent, 0)),
        "limit the parent": lambda: _limited(parent),
        "slow the parent down": lambda: os.setpriority(os.PRIO_PROCESS, parent, os.getpriority(os.PRIO_PROCESS, 0)),
        "connect by TCP": lambda: _connected(socket.AF_INET, stream, ("127.0.0.1", told["tcp"])),
        "send by UDP": lambda: _connected(socket.AF_INET, datagram, ("127.0.0.1", told["udp"])),
        "connect to a UNIX socket": lambda: _connected(socket.AF_UNIX, stream, told["unix"]),
        "connect to an abstract socket": lambda: _connected(socket.AF_UNIX, stream, told["abstract"]),
        "turn a pair of sockets": lambda: _pair_turned(told["datagrams"]),
        "send from a raw pair": lambda: _pair_of(socket.SOCK_RAW, told["datagrams"]),
        "listen": _bound,
        "use io_uring": lambda: _called(LIBRARY.syscall(IO_URING_SETUP, 4, ctypes.create_string_buffer(248))),
        "make a file elsewhere": lambda: (elsewhere / "made").write_text("x"),
        "append to a file elsewhere": lambda: open(secret, "ab").close(),
        "remove a file elsewhere": lambda: os.unlink(elsewhere / "spare"),
        "rename a file to here": lambda: os.rename(elsewhere / "other", own / "other"),
        "make a folder elsewhere": lambda: os.mkdir(elsewhere / "folder"),
        "leave a symbolic link": lambda: os.symlink(secret, own / "soft"),
        "leave a pipe": lambda: os.mkfifo(own / "pipe"),
        "open a file to all": lambda: os.chmod(secret, 0o644),
        "change a file's time": lambda: os.utime(secret, (1, 1)),
        "change a file's owner": lambda: os.chown(secret, os.getuid(), os.getgid()),
        "change the rights of an open file": lambda: _with_open(plain, lambda f: os.fchmod(f, 0o644)),
        "change the owner of an open file": lambda: _with_open(plain, lambda f: os.fchown(f, os.getuid(), os.getgid())),
        "change the times of an open file": lambda: _with_open(plain, lambda f: os.utime(f, (1, 1))),
        "change the attributes of an open file": lambda: _with_open(plain, lambda f: os.setxattr(f, "user.x", b"x")),
        "change a file's attributes": lambda: _attributes_set(secret),
        "be another user": _as_another,
        "make a device": lambda: os.mknod(own / "zero", 0o600 | stat.S_IFCHR, os.makedev(1, 5)),
        "move the parent to other processors": lambda: os.sched_setaffinity(parent, os.sched_getaffinity(parent)),
        "send to a queue": lambda: _queued(told["queue"]),
        "share memory": lambda: _called(LIBRARY.shmget(0x5EC1, 4096, 0o1600)),
        "make a namespace": lambda: _called(LIBRARY.unshare(0x10000000)),
    }


def tried(told: dict[str, Any]) -> dict[str, str]:
    """Try them all."""
    found = {}
    for name, way in ways(told).items():
        try:
            way()
        except BaseException as error:
            found[name] = f"{type(error).__name__}: {error}"
        else:
            found[name] = "out"
    return found
