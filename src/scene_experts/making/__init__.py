"""From photographs to a page in one call."""
