"""`python -m cosim` is `cosim`; Ctrl-C ends it at any moment with exit code 130, also while it loads."""


def main() -> None:
    """Entry point of the console script."""
    try:
        from cosim.cli import main

        main()
    except KeyboardInterrupt:
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
