"""The two ways a command ends badly. Every message says what was expected, what was found and what to do, in one sentence."""


class InputError(Exception):
    """The user's input (a capture, a run folder, a flag) cannot be used. The command line exits with code 2."""


class RunError(Exception):
    """Something failed while working on good input (a full disk, an interrupted write). The command line exits with code 1."""
