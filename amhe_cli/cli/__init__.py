"""The command line: options -> inputs -> one call of the library -> what is printed and written.

`parsing` knows kinds of options, `options` those that commands share, `inputs` which system and logs are
meant; there is one file for each command. Nothing here imports numpy, MuJoCo or a log reader at the top of a
file, so that `amhe --help` answers at once.
"""
