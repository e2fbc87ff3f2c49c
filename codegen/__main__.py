"""`python -m codegen` is the command `codegen`."""

from codegen.cli import main

main(prog_name="codegen")
