"""The command line: one module per command.

A module `services.cli.<command>` offers `COMMAND`, a function whose signature and docstring tyro turns into options and
help, or `COMMANDS`, a dict of such functions for a group such as `congrasp objects import`. Where defaults depend on
the command line itself, `defaults(arguments)` returns them by the names of the function's parameters.

Heavy imports belong inside the functions, so that `--help` responds at once. Lines are printed directly; tables and
bars come from `services.cli.console`. Bad input is a `CongraspError`, which `services.cli.main` prints as one line; an
`int` that a function returns is the exit code.
"""
