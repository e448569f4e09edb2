"""The few errors of the stack; each message is a sentence that says what to do next."""

from __future__ import annotations


class CompanionError(Exception):
    """Anything that a user can mend; shown as one line, without a traceback."""

    exit_code = 1


class InputError(CompanionError):
    """A file, a key or an option is wrong: where, what, and the valid choices."""

    exit_code = 2

    def __init__(self, problem: str, *, file: str = "", line: int = 0, field: str = "", valid: str = "") -> None:
        self.problem, self.file, self.line, self.field, self.valid = problem, file, line, field, valid
        place = f"{file}:{line}: " if file and line else f"{file}: " if file else ""
        where = f"{field}: " if field else ""
        choices = f" (valid: {valid})" if valid else ""
        super().__init__(f"{place}{where}{problem}{choices}")


class LinkError(CompanionError):
    """The vehicle or the bus cannot be reached."""

    exit_code = 3
