"""Errors that a person or another program can act on.

InputError          misuse or bad input: names the field and the fix (exit code 2 at the command
                    line)
├── UnreachableError  a router or service does not answer (exit code 1)
└── WireError       a payload is not the message that it claims to be; the service refuses and
                    counts it
"""

from __future__ import annotations


class InputError(ValueError):
    """Input that cannot be used.

    Args:
        field: the name of the field, column, option or file that is wrong.
        problem: the fault.
        fix: how to correct it.
    """

    def __init__(self, field: str, problem: str, fix: str) -> None:
        super().__init__(f"{field}: {problem}; {fix}")
        self.field = field
        self.problem = problem
        self.fix = fix

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        return type(self), (self.field, self.problem, self.fix)


class UnreachableError(InputError):
    """A router or service that does not answer: the input may be right, and a later try may
    succeed.
    """


class WireError(InputError):
    """A payload that cannot be read as the message that its key or encoding claims."""
