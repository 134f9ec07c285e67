"""Benchmarks of the user's machine: one module for each command of `congrasp bench`."""
