"""From nothing to the paper's tables: trains what is missing, evaluates, and writes a page, JSON and LaTeX."""
