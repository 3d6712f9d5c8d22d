"""Check the facts in an error message and not its wording."""

import re


def naming(*facts: object) -> str:
    """A pattern for `pytest.raises(match=...)`: the message contains every fact, in any order.

    A fact is what the reader acts on: a flag, a file, a number, the name of a recipe or tensor.
    """
    return "(?s)" + "".join(f"(?=.*{re.escape(str(fact))})" for fact in facts)
