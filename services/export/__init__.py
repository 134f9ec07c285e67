"""Exports: policies and motions in formats of other programs, each checked when it is written.

An exporter writes a file, reads it back with another reader than the one that wrote it, and compares; a file that fails
is removed. Every file describes its numbers.
"""
