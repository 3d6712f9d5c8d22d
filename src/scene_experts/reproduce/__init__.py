"""The paper's tables and figures, from runs that are trained, resumed or reused."""
