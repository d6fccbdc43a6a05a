"""Common parts of both command lines: error handling, types of numbers, version, completion, quiet
mode.

Exit codes: 0 success, 1 finished but something failed or is left to do, 2 misuse or bad input, 3
implausible signals (edge-agent), 130 ended by Ctrl-C.
"""

from __future__ import annotations

import argparse
import errno
import math
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NamedTuple, NoReturn

from schemas.errors import InputError, UnreachableError
from schemas.runtime.installing import install_command

FAILED: Final = 1
BAD_INPUT: Final = 2
INTERRUPTED: Final = 130  # exit code 128 + SIGINT, as shells use it
SHELLS: Final = ("bash", "zsh", "tcsh")
# error numbers of a disk that has no more space for a file
FULL_DISK: Final = (errno.EDQUOT, errno.EFBIG, errno.ENOSPC)
# Optional extra of this project that installs a package.
EXTRA_OF: Final = {"scipy": "analytics", "matplotlib": "analytics"}
LAST_PORT: Final = 65_535
_NEGATIVE: Final = re.compile(r"^-[\d.]")


class Command(NamedTuple):
    """Subcommand of a command-line program: its name, the name of its module, its help text and an
    example. The module defines `add_arguments(parser)` and `run(arguments) -> int`.
    """

    name: str
    module: str
    help: str
    example: str


class OneLineParser(argparse.ArgumentParser):
    """Argument parser whose errors are one line, like those of the commands, without the usage
    text.
    """

    def error(self, message: str) -> NoReturn:
        """Print the error `message` and a reference to `--help` on one line of stderr, and exit
        with code 2.
        """
        self.exit(BAD_INPUT, f"error: {message}; see {self.prog} --help\n")


def parser_of(
    prog: str, description: str, commands: Iterable[Command], *chosen: str | None
) -> argparse.ArgumentParser:
    """Return a parser that knows all commands by name, and the options of the chosen commands only.
    Modules of other commands are not imported.
    """
    parser = OneLineParser(prog=prog, description=description)
    parser.add_argument("--version", action=VersionAction)
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in commands:
        sub = add_command(subparsers, command.name, command.help, command.example)
        if command.name in chosen:
            module = import_module(command.module)
            module.add_arguments(sub)
            sub.set_defaults(run=module.run)
    return parser


def join_negative_numbers(argv: Sequence[str]) -> list[str]:
    """Rewrite `--bbox -0.5,51,…` as `--bbox=-0.5,51,…`. Without this, argparse would take the value
    with its leading minus for an option.
    """
    out: list[str] = []
    for word in argv:
        if _NEGATIVE.match(word) and out and re.fullmatch(r"--[a-z-]+", out[-1]):
            out[-1] += f"={word}"
        else:
            out.append(word)
    return out


def add_command(
    commands: Any,  # noqa: ANN401 a private type of argparse
    name: str,
    about: str,
    example: str,
) -> argparse.ArgumentParser:
    """Add a subcommand with help text, example and the common options to a parser; return the
    subcommand's parser.
    """
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=about,
        description=about,
        epilog=f"example:\n  {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    louder = parser.add_mutually_exclusive_group()
    louder.add_argument(
        "-v", "--verbose", action="store_true", help="also show the log messages of libraries"
    )
    louder.add_argument("-q", "--quiet", action="store_true", help="show errors only")
    return parser


def parse_positive(text: str) -> float:
    """Return the value of an option that is a number above 0, such as a duration [s]. Infinity is
    allowed. The function is a `type` for argparse.

    Raises:
        argparse.ArgumentTypeError: `text` is not such a number.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not value > 0.0:
        raise argparse.ArgumentTypeError(f"{text[:60]!r} is not a positive number")
    return value


def parse_port(text: str) -> int:
    """Return the value of an option that is a port; 0 stands for a free port. The function is a
    `type` for argparse.

    Raises:
        argparse.ArgumentTypeError: `text` is not a port number.
    """
    if not is_port(text):
        problem = f"{text[:60]!r} is not a port (0 to {LAST_PORT})"
        raise argparse.ArgumentTypeError(problem)
    return int(text)


def is_port(text: str) -> bool:
    """Return True if `text` is a port number."""
    return text.isascii() and text.isdigit() and len(text) <= 5 and int(text) <= LAST_PORT


def wants_quiet(arguments: Sequence[str]) -> bool:
    """Return True if an unparsed command line contains `-q` or `--quiet` (print only errors)."""
    return not {"-q", "--quiet"}.isdisjoint(arguments)


class VersionAction(argparse.Action):
    """Action of the option `--version`: print the version of the installed distribution."""

    def __init__(self, option_strings: Sequence[str], dest: str, **_: object) -> None:
        super().__init__(
            option_strings,
            dest,
            nargs=0,
            help="show the version and exit",
            default=argparse.SUPPRESS,
        )

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        """Print the version and exit."""
        print(f"{parser.prog} {version()}")
        parser.exit(0)


def version() -> str:
    """Return the version of the installed distribution, or a note that it is not installed."""
    from importlib import metadata

    try:
        return metadata.version("gripmap")
    except metadata.PackageNotFoundError:
        return "unknown (not installed)"


def run_guarded(run: Callable[[], int]) -> int:
    """Run the function of a command. If it ends by misuse, Ctrl-C, a closed output pipe or a full
    disk, print at most one line and no traceback.

    Returns:
        the exit code.
    """
    try:
        return int(run())
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return FAILED if isinstance(error, UnreachableError) else BAD_INPUT
    except ModuleNotFoundError as error:
        name = (error.name or "").partition(".")[0]
        if name not in EXTRA_OF:
            raise
        fix = install_command(EXTRA_OF[name])
        print(f"error: packages: {name} is not installed; {fix}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of standard output has ended (`| head`), so nobody reads an error message.
        sys.stderr.close()
        return 0
    except OSError as error:
        if error.errno not in FULL_DISK:
            raise
        print(f"error: disk: {error.strerror}; free some space, or use another", file=sys.stderr)
        return FAILED


def check_out_file(field: str, path: Path) -> Path:
    """Check that a file can be written at `path`, and return the path. A command calls this before
    it computes anything. `field` is the option's name for error messages.

    Raises:
        InputError: the path is a folder, or its parent folder does not exist.
    """
    if path.is_dir():
        raise InputError(field, f"{path} is a folder", "name a file")
    if not path.absolute().parent.is_dir():
        raise InputError(
            field,
            f"cannot write {path} (No such file or directory)",
            "name a file in an existing folder",
        )
    return path


@contextmanager
def report_write_errors(path: Path) -> Iterator[None]:
    """Provide a context that converts errors of writing the `--out` file into input errors.

    Raises:
        InputError: the file cannot be written.
    """
    try:
        yield
    except OSError as error:
        raise InputError(
            "out", f"cannot write {path} ({error.strerror})", "name a file that you may write"
        ) from error


def check_ending(field: str, path: Path, known: Sequence[str]) -> str:
    """Return the ending of a file name, which selects the file format. If several of the `known`
    endings match, return the longest. `field` is the option's name for error messages.

    Raises:
        InputError: the ending is unknown.
    """
    fits = [one for one in known if path.name.endswith(one)]
    if not fits:
        raise InputError(
            field, f"{path.name} has no known ending", f"use one of {', '.join(known)}"
        )
    return max(fits, key=len)


def refuse_input_path(field: str, out: Path, inputs: Sequence[Path]) -> None:
    """Raise an error if the output file `out` would overwrite one of the input files.

    Raises:
        InputError: the file to write is one of the inputs.
    """
    for source in inputs:
        if out.resolve() == source.resolve():
            raise InputError(field, f"would overwrite the input {source}", "name another file")


def completion(parser: argparse.ArgumentParser, shell: str) -> str:
    """Return the script by which a shell completes this program's commands and options at the tab
    key.

    Raises:
        InputError: the shell is not supported.
    """
    if shell not in SHELLS:
        raise InputError("shell", f"{shell!r} is unknown", f"use one of {', '.join(SHELLS)}")
    import shtab

    script: Any = shtab.complete(parser, shell)
    return str(script)
