"""`python -m amhe_cli` is the command `amhe`."""

from amhe_cli.cli.main import main

main()
