"""The places that a program must be able to read to run at all, without its neighbours."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from specimap_core.sandbox import landlock

Mode = Literal["require", "best-effort", "off"]
MODES: tuple[str, ...] = get_args(Mode)
Rule = tuple[str, int]
"""A place and Landlock's rights to it."""

_SHARED = ("/usr", "/usr/local")
_LIBRARIES = (
    *(
        f"{prefix}/{name}"
        for prefix in _SHARED
        for name in ("bin", "sbin", "lib", "lib32", "lib64", "libexec", "share", "include")
    ),
    "/lib",
    "/lib32",
    "/lib64",
    "/bin",
    "/sbin",
    "/nix/store",
    "/gnu/store",
)
_FILES = (
    "/etc/ld.so.cache",
    "/etc/ld.so.conf",
    "/etc/ld.so.conf.d",
    "/etc/localtime",
    "/etc/timezone",
    "/etc/passwd",
    "/etc/group",
    "/etc/nsswitch.conf",
    "/etc/hosts",
    "/etc/mime.types",
    "/etc/fonts",
    "/etc/alternatives",
    "/etc/OpenCL",
    "/proc/cpuinfo",
    "/proc/meminfo",
    "/proc/stat",
    "/proc/filesystems",
    "/proc/version",
    "/proc/sys/vm",
    "/proc/self",
    "/sys/devices/system",
    "/sys/fs/cgroup",
    "/dev/urandom",
    "/dev/random",
    "/dev/zero",
)
_CACHES = ("matplotlib", "specimap")
"""Below the user's cache folder: lists of fonts, and the sums of weights."""
_GPU_PLACES = ("/proc", "/sys")
"""What NVIDIA's driver is asked by. Landlock keeps other processes' memory and environment out of /proc by itself."""
_CORE = Path(__file__).resolve().parents[1]
_GPU_MARKS = ("/dev/nvidiactl", "/dev/dxg")


@dataclass(frozen=True)
class Reach:
    """The places that a process may reach apart from its program.

    ``read`` and ``write`` are files or folders, ``run`` too, with programs in them. ``keep_from``: places that no rule
    of the program's own may cover, though they lie in its way, such as a database next to an interpreter.
    """

    read: Sequence[Path] = ()
    write: Sequence[Path] = ()
    run: Sequence[Path] = ()
    keep_from: Sequence[Path] = ()


def program_rules(reach: Reach) -> list[Rule]:
    """The rules for this interpreter with its modules, for the system's libraries, and for ``reach``."""
    kept = [_real(path) for path in reach.keep_from]
    data = [*kept, *(_real(path) for path in (*reach.read, *reach.write))]
    own = [(place, landlock.RUN) for place in (*map(Path, _LIBRARIES), *_of_interpreter(), *reach.run)]
    own += [(place, landlock.READ) for place in (*map(Path, _FILES), *_module_folders(data), *_caches())]
    # Python finds a module by listing its folder.
    own += [(package.parent, landlock.READ_DIR) for package in _own_packages()]
    own.append((Path("/dev/null"), landlock.READ | landlock.WRITE_FILE))
    if any(map(os.path.exists, _GPU_MARKS)):
        own += [(Path(place), landlock.READ) for place in _GPU_PLACES]
        own += [(place, landlock.DEVICE) for place in _gpu_devices()]
    found = {
        (str(part), rights)
        for place, rights in own
        for part in ([place] if rights == landlock.READ_DIR else _without(_real(place), kept))
    }
    found |= {(str(_real(path)), landlock.READ) for path in reach.read}
    found |= {(str(_real(path)), landlock.WRITE) for path in reach.write}
    return sorted(found)


def _real(path: Path) -> Path:
    # /proc/self is another place in each process: it stays as it is.
    return path if path == Path("/proc/self") else Path(os.path.realpath(path))


def _without(place: Path, kept: Sequence[Path]) -> Iterator[Path]:
    """``place``, or where it holds something to be kept from, all other things in it."""
    if place in kept:
        return
    if not any(place in path.parents for path in kept):
        yield place
        return
    try:
        inside = sorted(place.iterdir())
    except OSError:
        return
    for part in inside:
        if not part.is_symlink():
            yield from _without(part, kept)


def _of_interpreter() -> Iterator[Path]:
    prefixes = {sys.prefix, sys.exec_prefix, sys.base_prefix, sys.base_exec_prefix}
    yield from (Path(place) for place in prefixes if place not in _SHARED)
    yield from interpreter_places(sys.executable)
    yield from Path("/usr/local").glob("cuda*")
    yield from (Path(place) for place in os.environ.get("LD_LIBRARY_PATH", "").split(":") if place)


def _module_folders(data: Sequence[Path]) -> Iterator[Path]:
    """Folders of modules, but none that holds other things too: where data lie, or where the program was started."""
    yield from _own_packages()
    main = getattr(sys.modules.get("__main__"), "__file__", None)
    # Of the source's folders the packages alone: a stray file next to one is not the program's.
    left_out = {_real(Path(os.curdir)), *([_real(Path(main)).parent] if main else [])}
    left_out |= {_real(package.parent) for package in _own_packages()}
    for place in map(Path, filter(None, sys.path)):
        if _real(place) not in left_out and not any(_real(place) in path.parents for path in data):
            yield place
    if _CORE.parent.name in ("site-packages", "dist-packages"):
        yield _CORE.parent


def _own_packages() -> Iterator[Path]:
    """The folders of Specimap's packages, which may stand apart, each in a folder of the source."""
    yield _CORE
    for place in map(Path, filter(None, sys.path)):
        yield from (found.parent for found in place.glob("specimap_*/__init__.py"))


def _caches() -> Iterator[Path]:
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    yield from (Path(home, name) for name in _CACHES)


def _gpu_devices() -> Iterator[Path]:
    for pattern in ("nvidia*", "dxg", "dri/*"):
        yield from Path("/dev").glob(pattern)


def interpreter_places(python: str) -> Iterable[Path]:
    """What another interpreter is made of: its own environment and the one that this was made from. Of one that stands
    elsewhere, as a link in a home folder may, the program alone."""
    for path in map(Path, (os.path.abspath(python), os.path.realpath(python))):
        prefix = path.parent.parent
        whole = (prefix / "pyvenv.cfg").is_file() or any(prefix.glob("lib*/python3*/os.py"))
        yield prefix if whole else path
