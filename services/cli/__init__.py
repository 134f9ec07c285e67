"""The command line: one module per command, here or, for those in `main._MODULES`, in another
folder of `services`.

Such a module offers `COMMAND`: a function, whose parameters are the options, or a frozen dataclass
with `__call__`, whose fields are. tyro turns them and their docstrings into options and help. A
group such as `congrasp objects import` has a dict of them, `COMMANDS`. Where defaults depend on the
command line itself, `defaults(arguments)` returns them by the names of the parameters.

Heavy imports belong inside the functions, so that `--help` responds at once, unless options need
them anyway. Lines are printed directly; tables and bars come from `services.cli.console`. Bad input
is a `CongraspError`, which `services.cli.main` prints as one line; an `int` that a command returns
is the exit code.
"""
