"""Floor 5, the command line: it parses, calls one function below, and writes; one file per command.

Nothing here imports numpy, MuJoCo or a log reader at the top of a file: `amhe --help` answers at once.
"""
