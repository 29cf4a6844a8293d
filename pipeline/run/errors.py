"""The five errors a user can meet, one exit code each.

InsituError
|- ManifestError   2  fix the text: capture.toml, scene.toml, a switch
|- CaptureError    3  fix the photographs: clipped shortest frame, marker not seen, no ball
|- ArtifactError   4  fix the build: a file of an earlier stage is missing, damaged or in the wrong space
|- ToolError       5  an external program or library failed; its log is kept
`- NumericalError  6  an estimator did not converge or has no unique answer

Messages read *where: what was found, what was needed, what to do*. Bugs are not caught.
"""

from __future__ import annotations


class InsituError(Exception):
    """Base of every error that is the user's to act on."""

    exit_code = 1


class ManifestError(InsituError):
    """The text of a manifest or a switch is wrong. ``problems`` holds all of them, one line each."""

    exit_code = 2

    def __init__(self, *problems: str) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


class CaptureError(InsituError):
    """The photographs do not allow what was asked."""

    exit_code = 3


class ArtifactError(InsituError):
    """A file of the build is missing, damaged, or not what its reader expects."""

    exit_code = 4


class ToolError(InsituError):
    """An external program or library failed."""

    exit_code = 5


class NumericalError(InsituError):
    """An estimator did not converge, or its answer is not unique."""

    exit_code = 6
