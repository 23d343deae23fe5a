"""The child's side of :mod:`specimap_core.sandbox.process`: runs a script of ours in another interpreter.

Run as a program: ``python child.py FOLDER DESCRIPTOR``. The interpreter needs NumPy and what the script needs, and
need not have Specimap installed: of it, only this file's own package can be imported, without the packages that are
installed next to it.

The script is a module with ``run(request, arrays, step)``, which returns arrays and facts (JSON values). It reports
its progress with ``step(name, share)`` and refuses by raising leaves of SpecimapError.
"""

from __future__ import annotations

import sys

if __name__ == "__main__" and sys.path:
    # The folder of this file comes first on the path; its modules must not stand in for others of the same name.
    del sys.path[0]

import importlib.util
import json
import os
import signal
import subprocess
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

REQUEST, ARRAYS, ANSWER = "request.json", "arrays.npz", "answer.npz"

Arrays = Mapping[str, Any]
Step = Callable[[str, float], None]
Run = Callable[[dict[str, Any], dict[str, Any], Step], "tuple[Arrays, Mapping[str, object]]"]


def expose_package() -> None:
    """Make ``specimap_core`` importable where it is not installed, without the packages that lie next to it."""
    package = ModuleType("specimap_core")
    package.__path__ = [str(Path(__file__).resolve().parents[1])]
    sys.modules["specimap_core"] = package


def end_with_parent(folder: Path) -> None:
    """End the whole process group, and remove its scratch folder, when the parent closes our standard input.

    The system closes it whichever way the parent ends.
    """

    def watch() -> None:
        while os.read(0, 1):
            pass
        # A process of another group removes the folder, once nothing writes to it any more.
        remove = ["/bin/sh", "-c", 'sleep 1; rm -rf "$0"', str(folder)]
        subprocess.Popen(remove, start_new_session=True)  # noqa: S603 - a folder that Specimap made and named
        os.killpg(0, signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


def refuse_network() -> None:
    """No data leaves this machine: connecting and resolving names raise. Sockets between processes stay possible."""
    import socket

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "socket.getaddrinfo" or (
            event in ("socket.connect", "socket.sendto") and arguments[0].family != socket.AF_UNIX
        ):
            raise PermissionError("A reconstruction reaches no network.")

    sys.addaudithook(hook)


def error_fields(error: BaseException) -> dict[str, Any]:
    """An error as the parent reads it: as of ``SpecimapError.as_dict``, for other errors with codes of this module."""
    from specimap_core.errors import SpecimapError

    if isinstance(error, SpecimapError):
        return error.as_dict()
    text = f"{type(error).__name__}: {error}"
    if isinstance(error, ImportError):
        return {"code": "import", "message": text, "details": {"module": error.name or ""}}
    low = text.lower()
    exhausted = "outofmemory" in low or "out of memory" in low or "can't allocate memory" in low
    if exhausted or isinstance(error, MemoryError):
        return {"code": "memory", "message": text, "details": {}}
    places = traceback.extract_tb(error.__traceback__)
    at = f"{Path(places[-1].filename).name}:{places[-1].lineno}" if places else ""
    return {"code": "crash", "message": text, "details": {"at": at}}


def _sender(descriptor: int) -> Callable[..., None]:
    os.set_inheritable(descriptor, False)

    def send(**event: object) -> None:
        os.write(descriptor, (json.dumps(event, default=str) + "\n").encode())

    return send


def _script(path: str) -> Run:
    spec = importlib.util.spec_from_file_location("specimap_child_script", path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is not a Python file", name=path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    run: Run = module.run
    return run


def _causes(error: BaseException) -> Iterator[BaseException]:
    cause: BaseException | None = error
    while cause is not None:
        yield cause
        cause = cause.__cause__ or cause.__context__


def main() -> None:
    """Answer one request."""
    folder, send = Path(sys.argv[1]), _sender(int(sys.argv[2]))
    end_with_parent(folder)
    expose_package()
    refuse_network()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        import numpy as np

        request = json.loads((folder / REQUEST).read_text("utf-8"))
        sys.path[:0] = request["extra_path"]
        with np.load(folder / ARRAYS, allow_pickle=False) as stored:
            arrays = dict(stored)
        run = _script(request["script"])
        found, facts = run(request["request"], arrays, lambda name, share: send(step=name, share=float(share)))
        aside = folder / ("." + ANSWER)
        with open(aside, "wb") as file:
            np.savez(file, allow_pickle=False, **found)
        os.replace(aside, folder / ANSWER)
        send(done=True, facts=dict(facts))
    except BaseException as error:
        traceback.print_exc()
        # A loader may wrap an exhausted memory or a missing module in an error of its own.
        answers = [error_fields(e) for e in _causes(error)]
        send(error=next((a for a in answers if a["code"] != "crash"), answers[0]))
    sys.stderr.flush()
    # Native libraries' threads may block the interpreter's end; the answer is on the disk.
    os._exit(0)


if __name__ == "__main__":
    main()
