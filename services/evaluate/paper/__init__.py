"""The paper's tables: its figures, their reproduction, and the comparison of both."""
