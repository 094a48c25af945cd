"""Entry point of `cosim` and `python -m cosim`. Ctrl-C exits with code 130, also during loading."""

from __future__ import annotations

import sys

from cosim import machine

NEED_NO_ENGINE = (
    "list",
    "show",
    "score",
    "compare",
    "merge",
    "listen",
    "inject",
    "direct",
    "dataset",
    "train",
)
"""Commands that start without the check of the machine."""


def main() -> None:
    """Run the command line, after checking the machine for commands that start an engine."""
    try:
        if _starts_an_engine(sys.argv[1:]) and (refusal := machine.refusal()):
            print(f"error: {refusal}", file=sys.stderr)
            raise SystemExit(machine.EXIT_CODE)
        try:
            from cosim.cli.app import main
        except ImportError as error:
            print(
                f"error: {error}. The installation is incomplete: `make run` repairs it",
                file=sys.stderr,
            )
            raise SystemExit(machine.EXIT_CODE) from None
        main()
    except KeyboardInterrupt:
        raise SystemExit(130) from None


def _starts_an_engine(words: list[str]) -> bool:
    return (
        bool(words)
        and not words[0].startswith("-")
        and words[0] not in NEED_NO_ENGINE
        and "--help" not in words
    )


if __name__ == "__main__":
    main()
