"""Reproduces the paper's tables: trains missing policies, evaluates, and writes a page, JSON and
LaTeX.
"""
