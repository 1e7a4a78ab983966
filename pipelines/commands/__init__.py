"""The command line, related commands in one file: request and outcome, the work, what is printed, the typer function.

`thermodrift --help` loads these modules, so they import what is heavy inside the functions that need it.
"""
