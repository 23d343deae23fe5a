"""``python -m bench.service``: see :mod:`bench.service.program`."""

from __future__ import annotations

from specimap_core.threads import limit_blas_threads


def main() -> None:
    """Run the parts asked for, print their tables, keep their figures."""
    limit_blas_threads()
    # Imported after that, since it loads numpy.
    from bench.service import program

    program.main()


if __name__ == "__main__":
    main()
