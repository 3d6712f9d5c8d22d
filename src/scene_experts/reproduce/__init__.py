"""The paper's tables and figures, from runs that are made, continued or reused."""
