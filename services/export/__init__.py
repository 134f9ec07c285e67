"""Exports: policies and motions in formats of other programs. Every file describes its numbers."""
