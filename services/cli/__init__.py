"""The command line: one module per command.

A module `services.cli.<command>` offers `COMMAND`, a function whose signature and docstring tyro turns into options and
help, or `COMMANDS`, a dict of such functions for a group such as `congrasp objects import`; a command with options that
depend on one another offers `parse`, which takes the arguments and returns the call to make. Heavy imports belong
inside the functions, so that `--help` answers at once. Lines are printed as they are; tables and bars come from
`services.cli.console`. Bad input is a `CongraspError`, which `services.cli.main` prints as one line; an `int` that a
function returns is the exit code.
"""
