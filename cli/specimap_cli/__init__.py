"""The command line."""


def main() -> None:
    """Run the console script."""
    from specimap_core.threads import limit_blas_threads

    limit_blas_threads()
    # Imported after that, since it loads numpy.
    from specimap_cli.app import app

    app()


__all__ = ["main"]
