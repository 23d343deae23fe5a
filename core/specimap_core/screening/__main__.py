"""``python -m specimap_core.screening``: the process of :mod:`specimap_core.screening.process`."""

from __future__ import annotations

import os

from specimap_core.threads import limit_blas_threads


def main() -> None:
    """Judge files until there are no more."""
    limit_blas_threads()
    # Imported after that, since it loads numpy.
    from specimap_core.screening import process

    process.main()


if __name__ == "__main__":
    main()
    # Native libraries' threads may block the interpreter's end.
    os._exit(0)
